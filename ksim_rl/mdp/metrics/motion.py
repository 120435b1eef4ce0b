"""These metrics say how well a velocity command is followed, and how smoothly."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import MetricTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfEntity


@dataclass(frozen=True, kw_only=True)
class LinearVelocityError(OfEntity, MetricTerm):
    """|c_xy - v_xy| between command and root velocity, both in the root's frame, m/s; velocity stage.

    Attributes:
        command: (vx, vy, wz), by name.
    """

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        error_E2 = view.command(self.command)[:, :2] - view.entity(self.entity).root_lin_vel_b_EL[:, :2]
        return torch.linalg.vector_norm(error_E2, dim=-1)


@dataclass(frozen=True, kw_only=True)
class AngularVelocityError(OfEntity, MetricTerm):
    """|c_z - w_z| between command and root velocity, both in the root's frame, rad/s; velocity stage.

    Attributes:
        command: (vx, vy, wz), by name.
    """

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (view.command(self.command)[:, 2] - view.entity(self.entity).root_ang_vel_b_EL[:, 2]).abs()


@dataclass(frozen=True, kw_only=True)
class ActionAcceleration(MetricTerm):
    """Mean over columns of |a_t - 2 a_{t-1} + a_{t-2}|; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        rate_EL = view.action_EL - view.last_action_EL
        last_rate_EL = view.buffer("last_rate_EL", rate_EL.shape[-1])
        acceleration_E = (rate_EL - last_rate_EL).abs().mean(-1)
        last_rate_EL.copy_(rate_EL)
        return acceleration_E
