"""Estimates the advantages of a rollout, by GAE, lambda returns or V-trace, without host syncs."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    set_composite_lp_aggregate,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import value

from ksim_rl.objectives.estimator_options import normalizes
from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals, steps_of


def discounted_sum(
    term_ET: Float[Tensor, "*batch 1"], discount_ET: Float[Tensor, "*batch 1"], *, time_dim: int
) -> Float[Tensor, "*batch 1"]:
    """Return x with x_t = term_t + discount_t x_{t+1}; x after the last step is zero."""
    # Time first, and split into its steps: a loop over T small tensors, [*batch, 1] each.
    terms = term_ET.movedim(time_dim, 0).unbind(0)
    discounts = discount_ET.movedim(time_dim, 0).unbind(0)
    total = torch.zeros_like(terms[0])
    totals = []
    # Backward in time: each sum contains the one of the step after it.
    for term_t, discount_t in zip(reversed(terms), reversed(discounts), strict=True):
        total = torch.addcmul(term_t, discount_t, total)
        totals.append(total)
    return torch.stack(totals[::-1]).movedim(0, time_dim)


def _discounted_errors(
    signals: Signals, gamma: Tensor, lmbda: Tensor, weight: Tensor | float = 1.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the results of `_estimate` from sums of weighted TD errors, discounted by gamma lambda in each episode."""
    bootstrap_ET = signals.bootstrap(signals.value_ET_t_plus_1, gamma)
    delta_ET = weight * (signals.reward_ET + bootstrap_ET - signals.value_ET_t)
    finite_ET = delta_ET.isfinite()
    # The recursion is cut at the end of an episode, and at steps that are not finite.
    adv_ET = discounted_sum(
        torch.where(finite_ET, delta_ET, torch.zeros_like(delta_ET)),
        torch.where(finite_ET & ~signals.done_ET, gamma * lmbda, 0.0),
        time_dim=signals.time_dim,
    )
    return adv_ET, adv_ET + signals.value_ET_t, finite_ET


def _with_own_targets(
    estimate: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
    lmbda: Tensor,
    value_lmbda: float | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the results of `estimate(lmbda)`, with the value targets of another lambda if there is one."""
    adv_ET, target_ET, finite_ET = estimate(lmbda)
    if value_lmbda is not None:
        _, target_ET, _ = estimate(torch.full_like(lmbda, value_lmbda))
    return adv_ET, target_ET, finite_ET


class GAE(RolloutEstimator, value.GAE):
    """Computes `advantage` and `value_target` (Schulman et al., arXiv 1506.02438) as TorchRL's `GAE` does.

    With `value_lmbda` targets have a lambda of their own: 1 makes them Monte Carlo returns, which the value bootstraps
    at the end of the rollout and at truncations.
    """

    def __init__(
        self,
        *,
        lmbda: float,
        value_lmbda: float | None = None,
        normalize_advantage: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(
            lmbda=lmbda, normalize_advantage=normalizes(normalize_advantage, options), **options
        )
        self._value_lmbda = value_lmbda

    def _estimate(
        self, signals: Signals, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor]:
        def estimate(lmbda: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return _discounted_errors(signals, self.gamma, lmbda)

        return _with_own_targets(estimate, self.lmbda, self._value_lmbda)


class TDLambda(RolloutEstimator, value.TDLambdaEstimator):
    """Computes the lambda return as `value_target`, and its excess over the state value as `advantage`.

    It is TorchRL's `TDLambdaEstimator` (Sutton and Barto, Reinforcement Learning, 2nd ed., section 12.1): the return
    G_t = r_t + gamma ((1 - lambda) V(s_{t+1}) + lambda G_{t+1}), cut at the end of an episode. It equals
    `GAE`, except where the value after a step differs from the value of the next step, as with a target critic.
    `value_lmbda` is as in `GAE`.
    """

    def __init__(self, *, lmbda: float, value_lmbda: float | None = None, **options: Any) -> None:
        super().__init__(lmbda=lmbda, **options)
        self._value_lmbda = value_lmbda

    def _estimate(
        self, signals: Signals, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor]:
        # G_{t+1} is V_{t+1} + A_{t+1}: TD errors with this mean of both values after a step sum up to G_t - V_t.
        after_ET = signals.value_ET_t_plus_1
        # A value that is not finite must not spoil the step before it, whose mean would be NaN.
        following_ET = _shifted(
            signals.value_ET_t.nan_to_num(0.0, 0.0, 0.0), after_ET, signals.time_dim
        )

        def estimate(lmbda: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            mean_ET = torch.where(
                signals.done_ET, after_ET, after_ET + lmbda * (following_ET - after_ET)
            )
            return _discounted_errors(
                replace(signals, value_ET_t_plus_1=mean_ET), self.gamma, lmbda
            )

        return _with_own_targets(estimate, self.lmbda, self._value_lmbda)


class VTrace(RolloutEstimator, value.VTrace):
    """Computes the targets of the present policy from a rollout of an older one (Espeholt et al., arXiv 1802.01561).

    `value_target` is V(s_t) + delta_t + gamma c_t (value_target_{t+1} - V(s_{t+1})) with delta_t = rho_t (r_t + gamma
    V(s_{t+1}) - V(s_t)), rho_t = min(rho_thresh, ratio_t) and c_t = lmbda min(c_thresh, ratio_t); `advantage` is rho_t
    (r_t + gamma value_target_{t+1} - V(s_t)), where the present policy (`actor`) took the action `ratio_t` times as
    often as the one that collected. TorchRL's `VTrace` has lmbda 1, and takes the log-probability of an action that it
    draws itself, whose ratio has nothing to do with the data.
    """

    lmbda: Tensor
    rho_thresh: Tensor
    c_thresh: Tensor

    def __init__(
        self,
        *,
        actor: ProbabilisticTensorDictSequential | None = None,
        lmbda: float = 1.0,
        normalize_advantage: bool = False,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        **options: Any,
    ) -> None:
        if actor is None:
            actor = actor_network
        if actor is None:
            raise ValueError(
                "actor=None: V-trace needs the present policy, whose log-probabilities it compares"
            )
        super().__init__(
            actor_network=actor,
            normalize_advantage=normalizes(normalize_advantage, options),
            **options,
        )
        self.register_buffer("lmbda", torch.tensor(lmbda, device=self.gamma.device))

    @property
    def in_keys(self) -> list[NestedKey]:
        """The leaves that the data must have, or the arguments of a call without a TensorDict."""
        # Written out: the compiler cannot follow TorchRL's, which asks its base class for a property.
        keys = self.tensor_keys
        actor = self.actor_network
        critic = self.value_network
        if critic is None:
            observed = [keys.value]
        else:
            observed = list(critic.in_keys)
        read = [*observed, *actor.in_keys, *actor.dist_sample_keys, keys.sample_log_prob]
        flags = [keys.reward, keys.done, keys.terminated]
        following = [("next", key) for key in [*observed, *flags]]
        return list(dict.fromkeys([*read, *following]))

    def _estimate(
        self, signals: Signals, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor]:
        time_dim = signals.time_dim
        value_ET_t_plus_1 = signals.value_ET_t_plus_1
        # Truncated importance weights: rho scales the error of a step, c how far later errors reach back.
        ratio_ET = self._ratio(tensordict, signals)
        rho_ET = ratio_ET.clamp_max(self.rho_thresh)
        c_ET = self.lmbda * ratio_ET.clamp_max(self.c_thresh)
        _, target_ET, finite_ET = _discounted_errors(signals, self.gamma, c_ET, rho_ET)
        # Past the end of an episode, of the rollout, or a step that is not finite there is the value only.
        known_ET = ~signals.done_ET & _shifted(finite_ET, torch.zeros_like(finite_ET), time_dim)
        target_ET_t_plus_1 = _shifted(target_ET, value_ET_t_plus_1, time_dim)
        target_ET_t_plus_1 = torch.where(known_ET, target_ET_t_plus_1, value_ET_t_plus_1)
        bootstrap_ET = signals.bootstrap(target_ET_t_plus_1, self.gamma)
        adv_ET = rho_ET * (signals.reward_ET + bootstrap_ET - signals.value_ET_t)
        return adv_ET, target_ET, finite_ET

    def _ratio(self, tensordict: TensorDictBase, signals: Signals) -> Tensor:
        actor = self.actor_network
        keys = [*self.actor_network.in_keys, *self.actor_network.dist_sample_keys]
        # The states of a recurrent policy are in the data, so that each step can be judged by itself.
        with steps_of(actor):
            log_prob = self._in_rows(self._log_prob, tensordict.select(*keys), signals.time_dim)
        old_log_prob = tensordict.get(self.tensor_keys.sample_log_prob, None)
        if old_log_prob is None or old_log_prob.numel() != log_prob.numel():
            raise ValueError(
                f"VTrace needs {self.tensor_keys.sample_log_prob!r}, one number per step: got "
                f"{None if old_log_prob is None else tuple(old_log_prob.shape)} for {tuple(log_prob.shape)}; "
                f"the policy reads {actor.in_keys}"
            )
        return (log_prob.view_as(signals.reward_ET) - old_log_prob.view_as(signals.reward_ET)).exp()

    def _log_prob(self, rows: TensorDictBase) -> Tensor:
        dist = self.actor_network.get_dist(rows)
        if isinstance(dist, CompositeDistribution):
            # The log-probabilities of several actions are added up: the ratio is of all of them together.
            with set_composite_lp_aggregate(True):
                return dist.log_prob(rows)
        (action_key,) = self.actor_network.dist_sample_keys
        return dist.log_prob(rows.get(action_key))


def _shifted(leaf: Tensor, last: Tensor, time_dim: int) -> Tensor:
    """Return the leaf one step later, [..., T, ...], and `last` at the last step."""
    length = leaf.shape[time_dim]
    later = leaf.narrow(time_dim, 1, length - 1)
    end = last.narrow(time_dim, length - 1, 1)
    return torch.cat((later, end), time_dim)
