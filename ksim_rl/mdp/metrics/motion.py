"""Values to watch, float32 [E] per step; `reduce` says what of them is reported when an episode ends.

Others: `metrics_effort`, `metrics_feet`, `metrics_success`.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.envs.term import MetricTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class LinearVelocityError(MetricTerm):
    """|c_xy - v_xy| between command and root velocity, both in the root's frame, m/s; velocity stage.

    Attributes:
        command: (vx, vy, wz), by name.
        entity: the robot; "" is the first one.
    """

    command: str
    entity: str = ""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the value of the current state, [E]."""
        error_E2 = view.command(self.command)[:, :2] - view.entity(self.entity).root_lin_vel_b_EL[:, :2]
        return torch.linalg.vector_norm(error_E2, dim=-1)


@dataclass(frozen=True, kw_only=True)
class AngularVelocityError(MetricTerm):
    """|c_z - w_z| between command and root velocity, both in the root's frame, rad/s; velocity stage.

    Attributes:
        command: (vx, vy, wz), by name.
        entity: the robot; "" is the first one.
    """

    command: str
    entity: str = ""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the value of the current state, [E]."""
        return (view.command(self.command)[:, 2] - view.entity(self.entity).root_ang_vel_b_EL[:, 2]).abs()


@dataclass(frozen=True, kw_only=True)
class ActionAcceleration(MetricTerm):
    """Mean over columns of |a_t - 2 a_{t-1} + a_{t-2}|; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the value of the current state, [E]."""
        rate_EL = view.action_EL - view.last_action_EL
        last_rate_EL = view.buffer("last_rate_EL", rate_EL.shape[-1])
        acceleration_E = (rate_EL - last_rate_EL).abs().mean(-1)
        last_rate_EL.copy_(rate_EL)
        return acceleration_E
