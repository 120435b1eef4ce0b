"""These rewards rate the policy's actions as such, and whether the episode goes on or fails."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class Alive(RewardTerm):
    """1 in every step, [E]."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return torch.ones(view.num_envs, device=view.device)


@dataclass(frozen=True, kw_only=True)
class Terminated(RewardTerm):
    """1 in the step in which the episode ends by a failure, not by time, [E].

    With `scale_rewards_by_dt` the weight counts `step_dt` times. A world whose physics failed gets no reward at all.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.terminated_E.to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class ActionRateL2(RewardTerm):
    """|a_t - a_{t-1}|^2 of the policy's raw actions, [E]; the action before the first of an episode is 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (view.action_EL - view.last_action_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class ActionAccelerationL2(RewardTerm):
    """|a_t - 2 a_{t-1} + a_{t-2}|^2 of the policy's raw actions, [E]; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        rate_EL = view.action_EL - view.last_action_EL
        return _change(view, "last_rate_EL", rate_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class ActionJerkL2(RewardTerm):
    """|a_t - 3 a_{t-1} + 3 a_{t-2} - a_{t-3}|^2 of the policy's raw actions, [E]; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        acceleration_EL = _change(view, "last_rate_EL", view.action_EL - view.last_action_EL)
        return _change(view, "last_acceleration_EL", acceleration_EL).square().sum(-1)


def _change(view: EnvView, name: str, value_EL: Tensor) -> Tensor:
    """Return the change of a value since the last step, and remember the value."""
    last_EL = view.buffer(name, value_EL.shape[-1])
    change_EL = value_EL - last_EL
    last_EL.copy_(value_EL)
    return change_EL
