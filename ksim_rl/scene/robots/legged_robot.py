"""Robots for walking tasks: the facts beyond their models, and how menagerie robots are built."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import mujoco

from ksim_rl.checked import Checked, Share
from ksim_rl.physics import load_spec
from ksim_rl.scene.actuators import Actuator, set_actuators
from ksim_rl.scene.robots import edit
from ksim_rl.scene.robots.upright_root import UPRIGHT, free_root, name_all, turn_root


class LeggedRobot(Protocol):
    """A robot with a free root, position targets at its joints, and feet.

    Its model has a keyframe, its default pose, and the sensors `imu_lin_vel` (velocimeter), `imu_ang_vel` (gyro) and
    `root_angmom` (subtreeangmom).
    """

    name: ClassVar[str]
    root_body: ClassVar[str]  # the body with the free joint
    joint_names: ClassVar[tuple[str, ...]]  # in policy order, as in actions and joint observations
    foot_geoms: ClassVar[tuple[str, ...]]  # they tread on the ground; their friction is drawn
    foot_sites: ClassVar[tuple[str, ...]]  # one per foot, near its sole

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
class MenagerieRobot(Checked):
    """A `LeggedRobot` made from a model of MuJoCo Menagerie and the tables of facts in its own file."""

    init_pos: tuple[float, float, float]  # of the root in the stance, m
    init_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # (w, x, y, z)
    default_joint_pos: Mapping[str, float]  # the stance, rad, by joint name
    action_scale: Mapping[str, float]
    actuators: tuple[Actuator, ...]
    soft_joint_pos_limit_factor: Share = 0.9

    name: ClassVar[str]
    root_body: ClassVar[str]
    joint_names: ClassVar[tuple[str, ...]]
    foot_geoms: ClassVar[tuple[str, ...]]
    foot_sites: ClassVar[tuple[str, ...]]
    model: ClassVar[str]  # its name in the menagerie
    collision_geoms: ClassVar[tuple[edit.CollisionGeom, ...]]  # in place of the model's own
    sites: ClassVar[tuple[edit.Site, ...]]  # to move or to add
    imu: ClassVar[str] = "imu"  # one of the sites or of the model's
    overlaps: ClassVar[tuple[tuple[str, str], ...]] = ()  # bodies that pass through each other

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh, editable model of the robot alone, with keyframe `init_state`.

        Options, actuators, collision geoms, sensors and keyframes are replaced, and damping and friction of the driven
        joints removed; bodies, passive joints and visual geoms stay.
        """
        spec = load_spec(self.model)
        # Names and a free root come first, since the facts below refer to them.
        self._ready(spec)
        edit.reset_options(spec)
        # Before the actuators: these may bring losses of their own.
        edit.clear_joint_losses(spec, self.actuators)
        set_actuators(spec, self.actuators)
        edit.replace_collision_geoms(spec, self.collision_geoms)
        # Sites before the sensors that sit at them.
        edit.set_sites(spec, self.sites)
        edit.replace_sensors(spec, edit.root_sensors(imu=self.imu, root=self.root_body))
        pose = {
            "init_pos": self.init_pos,
            "init_quat": self.init_quat,
            "joint_pos": self.default_joint_pos,
        }
        # The keyframe needs the final joints and actuators.
        edit.set_keyframe(spec, "init_state", **pose)
        edit.exclude_contacts(spec, self.overlaps)
        return spec

    def _ready(self, spec: mujoco.MjSpec) -> None:
        """Ready the model's own spec for the robot's facts; models of the menagerie need nothing."""


@dataclass(frozen=True, kw_only=True)
class ModelRobot(MenagerieRobot):
    """The same with all facts as fields, such as `analyse` proposes them; `model` is a source for `load_spec`.

    Bodies and joints without a name are called by kind and place, such as "body3". `dropped` bodies, such as props, are
    left out with all that hangs on them. `free_root` frees a base that the model fixes to the world, and `root_turn`
    (w, x, y, z) turns the frame of the root, see `turn_root`. The model's own actuators are replaced as a whole; joints
    that `actuators` leave out are passive.
    """

    name: str
    root_body: str
    joint_names: tuple[str, ...]
    foot_geoms: tuple[str, ...]
    foot_sites: tuple[str, ...]
    model: str
    collision_geoms: tuple[edit.CollisionGeom, ...]
    sites: tuple[edit.Site, ...]
    imu: str = "imu"
    overlaps: tuple[tuple[str, str], ...] = ()
    dropped: tuple[str, ...] = ()
    free_root: bool = False
    root_turn: tuple[float, float, float, float] = UPRIGHT

    def _ready(self, spec: mujoco.MjSpec) -> None:
        name_all(spec)
        edit.drop_bodies(spec, self.dropped)
        if self.free_root:
            free_root(spec, self.root_body)
        if self.root_turn != UPRIGHT:
            turn_root(spec, self.root_body, self.root_turn)
        edit.drop_other_actuators(spec, self.actuators)
