"""Walking tasks read these facts of a robot, beyond its model; robots of the menagerie share how they are built."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import mujoco

from ksim_rl.physics import load_spec
from ksim_rl.scene.actuators import Actuator
from ksim_rl.scene.robots.edit import CollisionGeom, Site, exclude_contacts, rebuild


class LeggedRobot(Protocol):
    """A robot with a free root, position targets at its joints, and feet.

    Its model has a keyframe, its default pose, and the sensors `imu_lin_vel` (velocimeter), `imu_ang_vel` (gyro) and
    `root_angmom` (subtreeangmom).

    Attributes:
        name: how a scene calls it.
        root_body: the body with the free joint.
        joint_names: the actuated joints in policy order (that of actions and joint observations).
        foot_geoms: what treads on the ground; their friction is drawn.
        foot_sites: one site per foot, near its sole.
    """

    name: ClassVar[str]
    root_body: ClassVar[str]
    joint_names: ClassVar[tuple[str, ...]]
    foot_geoms: ClassVar[tuple[str, ...]]
    foot_sites: ClassVar[tuple[str, ...]]

    @property
    def action_scale(self) -> Mapping[str, float]:
        """Rad per unit action, by joint name or pattern."""
        ...

    @property
    def soft_joint_pos_limit_factor(self) -> float:
        """The part of each joint's range, about its middle, that is free of penalty."""
        ...

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the robot alone."""
        ...


@dataclass(frozen=True, kw_only=True)
class MenagerieRobot:
    """A `LeggedRobot` made from a model of MuJoCo Menagerie and the tables of facts in its own file.

    Attributes:
        init_pos, init_quat: the root's pose in the stance: m, and a quaternion (w, x, y, z).
        default_joint_pos: the stance, rad, by joint name.
        action_scale: rad per unit action, by joint name.
        actuators: what drives the joints.
        soft_joint_pos_limit_factor: the part of each joint's range, about its middle, that is free of penalty.
        joint_names: the actuated joints in policy order (that of actions and joint observations).
        model: the menagerie's name of the model.
        collision_geoms: what collides, in place of the model's own geoms.
        sites: sites to move or to add.
        imu: the site of the IMU.
        overlaps: pairs of bodies that pass through each other.
    """

    init_pos: tuple[float, float, float]
    init_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    default_joint_pos: Mapping[str, float]
    action_scale: Mapping[str, float]
    actuators: tuple[Actuator, ...]
    soft_joint_pos_limit_factor: float = 0.9

    name: ClassVar[str]
    root_body: ClassVar[str]
    joint_names: ClassVar[tuple[str, ...]]
    foot_geoms: ClassVar[tuple[str, ...]]
    foot_sites: ClassVar[tuple[str, ...]]
    model: ClassVar[str]
    collision_geoms: ClassVar[tuple[CollisionGeom, ...]]
    sites: ClassVar[tuple[Site, ...]]
    imu: ClassVar[str] = "imu"
    overlaps: ClassVar[tuple[tuple[str, str], ...]] = ()

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh, editable model of the robot alone, with keyframe `init_state`.

        Raises:
            ValueError: in one line, how to get the menagerie's model, if it is not at hand.
        """
        spec = load_spec(self.model)
        rebuild(spec, self, geoms=self.collision_geoms, sites=self.sites, imu=self.imu)
        exclude_contacts(spec, self.overlaps)
        return spec
