"""What a walking task needs to know about a robot, beyond its model."""

from collections.abc import Mapping
from typing import ClassVar, Protocol

import mujoco


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
