"""These rewards rate actions as such, left-right symmetry, and whether the episode goes on or fails."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checks import check_choice
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, index_constant, values_by_name
from ksim_rl.scene.names import Patterns


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


@dataclass(frozen=True, kw_only=True)
class Symmetry(RewardTerm):
    """What the terms of this file share.

    Attributes:
        left, right: joints that mirror each other, pair by pair in the order that the patterns give.
        signs: 1 or -1 by left joint: -1 where the mirror image turns the other way, as hip abduction does. Keys are
            regular expressions that match each left joint once.
    """

    left: Patterns
    right: Patterns
    signs: Mapping[str, float] = field(default_factory=lambda: {".*": 1.0})

    def __post_init__(self) -> None:
        super().__post_init__()
        for pattern, sign in self.signs.items():
            check_choice(f"signs[{pattern!r}]", sign, (1.0, -1.0))

    def _pairs(self, view: EnvView) -> tuple[list[str], list[str]]:
        """Return the names of left and right joints, pair by pair.

        Raises:
            ValueError: if their numbers differ.
        """
        left, right = view.joints(self.left).names, view.joints(self.right).names
        if len(left) != len(right):
            raise ValueError(
                f"left matches {left}, right matches {right}: give each left joint one right joint"
            )
        return left, right

    def _mismatch(self, view: EnvView, left_EP: Tensor, right_EP: Tensor) -> Tensor:
        """Return the sum over pairs of (left - sign * right)^2, [E]."""
        signs_P = constant(values_by_name("signs", self.signs, self._pairs(view)[0]), view.device)
        return torch.addcmul(left_EP, signs_P, right_EP, value=-1.0).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class JointSymmetryL2(Symmetry):
    """Sum over pairs of (x_left - sign x_right)^2, rad^2 or m^2, [E]; position stage.

    `x` is the deviation from the default pose.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        left, right = self._pairs(view)
        return self._mismatch(view, view.joints(left).pos_rel_EL, view.joints(right).pos_rel_EL)


@dataclass(frozen=True, kw_only=True)
class ActionSymmetryL2(Symmetry):
    """Sum over pairs of (a_left - sign a_right)^2 of the policy's raw actions, [E].

    Attributes:
        joints: those of the action term that reads the first columns of the action, one column each in this order.
    """

    joints: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        names = view.joints(self.joints).names
        columns = []
        for side in self._pairs(view):
            missing = [name for name in side if name not in names]
            if missing:
                raise ValueError(
                    f"joints={self.joints!r}: {missing[0]!r} of a pair is not among them: {names}"
                )
            columns.append(index_constant([names.index(name) for name in side], view.device))
        left, right = columns
        return self._mismatch(view, view.action_EL[:, left], view.action_EL[:, right])
