"""These rewards rate how well a command is followed: a velocity, a height, a pose, joint positions; or any value."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.pose import OfTarget, target_pose_w
from ksim_rl.mdp.fields import GaussianReward, InFrame, OfEntity, OfJoints
from ksim_rl.mdp.quantities import root_height
from ksim_rl.scene import quaternion


def tolerance(
    value: Float[Tensor, "*shape"],
    *,
    low: float = -math.inf,
    high: float = math.inf,
    margin: float,
    value_at_margin: float = 0.1,
    shape: Literal["gaussian", "linear"] = "gaussian",
) -> Float[Tensor, "*shape"]:
    """Return 1 inside [low, high], falling to `value_at_margin` at `margin` outside of it and on towards 0.

    Formula: Tassa et al., "DeepMind Control Suite" (2018), section 4. With d the distance to the interval in margins,
    "gaussian" is `value_at_margin ** (d ** 2)` and "linear" is `max(0, 1 - (1 - value_at_margin) d)`.

    Args:
        low, high: the interval, in the unit of `value`.
        margin: > 0, in the unit of `value`.
        value_at_margin: in (0, 1), or 0 for "linear".
    """
    distance = torch.clamp(torch.maximum(low - value, value - high), min=0.0) / margin
    if shape == "linear":
        return torch.clamp(1.0 - (1.0 - value_at_margin) * distance, min=0.0)
    return torch.exp(distance.square() * math.log(value_at_margin))


@dataclass(frozen=True, kw_only=True)
class TrackLinearVelocity(OfEntity, GaussianReward):
    """exp(-(|c_xy - v_xy|^2 + v_z^2) / std^2), `v` the root's linear velocity in its own frame, m/s, [E]."""

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        vel_E3 = view.entity(self.entity).root_lin_vel_b_EL
        error_E2 = view.command(self.command)[:, :2] - vel_E3[:, :2]
        return self.rate(error_E2.square().sum(-1) + vel_E3[:, 2].square())


@dataclass(frozen=True, kw_only=True)
class TrackAngularVelocity(OfEntity, GaussianReward):
    """exp(-((c_z - w_z)^2 + |w_xy|^2) / std^2), `w` the root's angular velocity in its own frame, rad/s, [E]."""

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        vel_E3 = view.entity(self.entity).root_ang_vel_b_EL
        error_E = view.command(self.command)[:, 2] - vel_E3[:, 2]
        return self.rate(error_E.square() + vel_E3[:, :2].square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TrackRootHeight(OfEntity, GaussianReward):
    """exp(-(c - h)^2 / std^2), `h` the height of the root body's frame above the ground, m, [E]; position stage.

    Attributes:
        command: a height, m, such as `BaseHeightCommand`.
    """

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        error_E = view.command(self.command)[:, 0] - root_height(view, self.entity)
        return self.rate(error_E.square())


@dataclass(frozen=True, kw_only=True)
class TrackPosition(OfTarget, GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of a body or site from the commanded position, m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.distance(view).square())


@dataclass(frozen=True, kw_only=True)
class TrackOrientation(InFrame, GaussianReward):
    """exp(-a^2 / std^2), `a` the angle between a body and the commanded orientation, rad; position stage.

    Attributes:
        command: position and quaternion [E, 7], such as `CartesianCommand` or `StartPoseCommand`, in `frame`.
        body: what should have that orientation.
    """

    command: str
    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        command_EK = view.command(self.command)
        _, target_E4 = target_pose_w(view, command_EK, frame=self.frame, entity=self.entity)
        if target_E4 is None:
            raise ValueError(
                f"command={self.command!r} has {command_EK.shape[1]} numbers: expected position and quaternion"
            )
        quat_E4 = view.body(self.body).quat_EL
        return self.rate(quaternion.angle_between(quat_E4, target_E4).square())


@dataclass(frozen=True, kw_only=True)
class TrackJointPosition(OfJoints, GaussianReward):
    """exp(-mean_j((c_j - q_j)^2) / std^2), rad or m, [E]; position stage.

    Attributes:
        command: positions of `joints`, in their order, such as `JointPositionCommand`.
    """

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        error_EL = view.command(self.command) - view.joints(self.joints).pos_EL
        return self.rate(error_EL.square().mean(-1))
