"""Reset events for one quantity each; they may follow `ResetRootUniform` and `ResetJoints` in the same reset."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.checks import check_pair
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.events.resets import free_root_of
from ksim_rl.mdp.root_height import root_height
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class ResetJointsByScale(EventTerm):
    """Put joints at their default positions times a uniform factor, per joint; positions stay in the soft limits.

    Attributes:
        position_scale: the factor's range.
        velocity_range: rad/s or m/s, uniform.
        joints: names or patterns.
    """

    position_scale: tuple[float, float]
    velocity_range: tuple[float, float] = (0.0, 0.0)
    joints: Patterns = ".*"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair("position_scale", self.position_scale)
        check_pair("velocity_range", self.velocity_range)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write the rows of `mask_E`."""
        joints = view.joints(self.joints)
        default_EN, limits_N2 = joints.default_pos_EL, joints.soft_limits_L2
        count = default_EN.shape[1]
        pos_EN = default_EN * view.uniform(count, *self.position_scale)
        joints.write_pos(mask_E, torch.clamp(pos_EN, limits_N2[:, 0], limits_N2[:, 1]))
        joints.write_vel(mask_E, view.uniform(count, *self.velocity_range))


@dataclass(frozen=True, kw_only=True)
class ResetHeading(EventTerm):
    """Turn the free root body about the world's z axis until its heading is a drawn one; its tilt stays.

    Attributes:
        heading_range: rad.
        entity: the robot or object; "" is the first robot.
    """

    heading_range: tuple[float, float] = (-math.pi, math.pi)
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair("heading_range", self.heading_range)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write the rows of `mask_E`."""
        body = free_root_of(view, self, self.entity)
        turn_E = view.uniform(1, *self.heading_range)[:, 0] - body.heading_E
        nothing_E = torch.zeros_like(turn_E)
        turn_E4 = quaternion.from_euler_xyz(nothing_E, nothing_E, turn_E)
        body.write_root_pose(mask_E, body.root_pos_EL, quaternion.multiply(turn_E4, body.root_quat_EL))


@dataclass(frozen=True, kw_only=True)
class ResetHeight(EventTerm):
    """Lift or lower the free root body until it is a drawn height above the ground right below it.

    Attributes:
        height_range: m.
        entity: the robot or object; "" is the first robot.
    """

    height_range: tuple[float, float]
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair("height_range", self.height_range)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write the rows of `mask_E`."""
        body = free_root_of(view, self, self.entity)
        rise_E1 = view.uniform(1, *self.height_range) - root_height(view, self.entity)[:, None]
        pos_E3 = torch.cat((body.root_pos_EL[:, :2], body.root_pos_EL[:, 2:] + rise_E1), dim=-1)
        body.write_root_pose(mask_E, pos_E3, body.root_quat_EL)
