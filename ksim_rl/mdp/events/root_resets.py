"""These events reset the pose, velocity, heading or height of a free root."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checked import Range
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp import se3_ranges
from ksim_rl.mdp.events.free_root import OfFreeRoot
from ksim_rl.mdp.quantities import root_height
from ksim_rl.scene import quaternion


@dataclass(frozen=True, kw_only=True)
class ResetRootUniform(OfFreeRoot, EventTerm):
    """Put the free root body at its default pose plus a uniform offset, with a uniform velocity.

    On a terrain the default pose stands at the env's origin.

    Attributes:
        pose_range: by axis: x, y, z (m, world frame), roll, pitch, yaw (rad, in the default pose's frame).
        velocity_range: by axis: x, y, z (m/s), roll, pitch, yaw (rad/s), world frame.
    """

    pose_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    velocity_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        se3_ranges.check_ranges("pose_range", self.pose_range)
        se3_ranges.check_ranges("velocity_range", self.velocity_range)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = self.root_of(view)
        offset_E6 = se3_ranges.draw(view, self.pose_range)
        velocity_E6 = se3_ranges.draw(view, self.velocity_range)
        turn_E4 = quaternion.from_euler_xyz(*offset_E6[:, 3:].unbind(-1))
        quat_E4 = quaternion.multiply(body.default_root_quat_L.expand(view.num_envs, 4), turn_E4)
        pos_E3 = body.default_root_pos_L + offset_E6[:, :3]
        if not view.terrain.is_flat:
            pos_E3 = pos_E3 + view.terrain.origins_E3
        body.write_root_pose(mask_E, pos_E3, quat_E4)
        body.write_root_velocity(mask_E, velocity_E6[:, :3], velocity_E6[:, 3:])


@dataclass(frozen=True, kw_only=True)
class ResetHeading(OfFreeRoot, EventTerm):
    """Turn the free root body about the world's z axis until its heading is a drawn one; its tilt stays.

    It may follow `ResetRootUniform` in the same reset.

    Attributes:
        heading_range: rad.
    """

    heading_range: Range = (-math.pi, math.pi)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = self.root_of(view)
        turn_E = view.uniform(1, *self.heading_range)[:, 0] - body.heading_E
        nothing_E = torch.zeros_like(turn_E)
        turn_E4 = quaternion.from_euler_xyz(nothing_E, nothing_E, turn_E)
        body.write_root_pose(mask_E, body.root_pos_EL, quaternion.multiply(turn_E4, body.root_quat_EL))


@dataclass(frozen=True, kw_only=True)
class ResetHeight(OfFreeRoot, EventTerm):
    """Lift or lower the free root body until it is a drawn height above the ground right below it.

    It may follow `ResetRootUniform` in the same reset.

    Attributes:
        height_range: m.
    """

    height_range: Range

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = self.root_of(view)
        rise_E1 = view.uniform(1, *self.height_range) - root_height(view, self.entity)[:, None]
        pos_E3 = torch.cat((body.root_pos_EL[:, :2], body.root_pos_EL[:, 2:] + rise_E1), dim=-1)
        body.write_root_pose(mask_E, pos_E3, body.root_quat_EL)
