"""Events that write the state: the resets and the push that most tasks use.

Others: `events_reset`, `events_push`, `events_motion`. Randomization of the model: `randomize`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from ksim_rl.checks import check_choice, check_in_range, check_pair
from ksim_rl.envs.term import EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp import se3_ranges
from ksim_rl.mdp.constants import constant
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.entity import Entity


@dataclass(frozen=True, kw_only=True)
class ResetRootUniform(EventTerm):
    """Put the free root body at its default pose plus a uniform offset, with a uniform velocity.

    On a terrain the default pose stands at the env's origin.

    Attributes:
        pose_range: by axis: x, y, z (m, world frame), roll, pitch, yaw (rad, in the default pose's frame).
        velocity_range: by axis: x, y, z (m/s), roll, pitch, yaw (rad/s), world frame.
        entity: the robot or object; "" is the first robot.
    """

    pose_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    velocity_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        se3_ranges.check_ranges("pose_range", self.pose_range)
        se3_ranges.check_ranges("velocity_range", self.velocity_range)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write the rows of `mask_E`."""
        body = free_root_of(view, self, self.entity)
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
class ResetJoints(EventTerm):
    """Put joints at their default positions plus an offset, at a drawn velocity; positions stay in the soft limits.

    Attributes:
        position_range: rad or m. With `distribution="gaussian"`: (mean, standard deviation).
        velocity_range: rad/s or m/s; likewise.
        joints: names or patterns.
    """

    position_range: tuple[float, float] = (0.0, 0.0)
    velocity_range: tuple[float, float] = (0.0, 0.0)
    joints: Patterns = ".*"
    distribution: Literal["uniform", "gaussian"] = "uniform"

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("distribution", self.distribution, ("uniform", "gaussian"))
        for name in ("position_range", "velocity_range"):
            if self.distribution == "uniform":
                check_pair(name, getattr(self, name))
            else:
                check_in_range(f"{name}[1]", getattr(self, name)[1], low=0.0)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write the rows of `mask_E`."""
        joints = view.joints(self.joints)
        default_EL, limits_L2 = joints.default_pos_EL, joints.soft_limits_L2
        count = default_EL.shape[1]
        pos_EL = default_EL + self._draw(view, count, self.position_range)
        joints.write_pos(mask_E, torch.clamp(pos_EL, limits_L2[:, 0], limits_L2[:, 1]))
        joints.write_vel(mask_E, self._draw(view, count, self.velocity_range))

    def _draw(self, view: EnvView, count: int, pair: tuple[float, float]) -> Tensor:
        first, second = float(pair[0]), float(pair[1])
        if second == (0.0 if self.distribution == "gaussian" else first):
            return constant([first] * count, view.device).expand(view.num_envs, count)
        if self.distribution == "gaussian":
            return first + second * view.normal(count)
        return view.uniform(count, first, second)


@dataclass(frozen=True, kw_only=True)
class PushByVelocity(EventTerm):
    """Kick the free root body: add a uniform draw to its velocity, whatever its mass.

    Attributes:
        velocity_range: by axis: x, y, z (m/s), roll, pitch, yaw (rad/s), world frame.
        entity: the robot or object; "" is the first robot.
    """

    velocity_range: Mapping[str, tuple[float, float]]
    mode: Literal["startup", "reset", "interval", "step"] = "interval"
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        se3_ranges.check_ranges("velocity_range", self.velocity_range)

    def __call__(self, view: EnvView, mask_E: Tensor) -> None:
        """Write the rows of `mask_E`."""
        body = free_root_of(view, self, self.entity)
        kick_E6 = se3_ranges.draw(view, self.velocity_range)
        lin_vel_E3 = body.root_lin_vel_w_EL + kick_E6[:, :3]
        body.write_root_velocity(mask_E, lin_vel_E3, body.root_ang_vel_w_EL + kick_E6[:, 3:])


def free_root_of(view: EnvView, term: EventTerm, entity: str) -> Entity:
    """Return the entity whose root `term` moves.

    Raises:
        ValueError: if there is no such entity, or its root is fixed.
    """
    body = view.entity(entity)
    if not body.free_root:
        raise ValueError(
            f"{type(term).__name__} needs a robot whose first joint is free; the root of {body.name!r} is fixed"
        )
    return body
