"""Estimates the advantages of a rollout, by GAE, lambda returns or V-trace, without host syncs."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    dispatch,
    set_composite_lp_aggregate,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import value
from torchrl.objectives.value import ValueEstimatorBase

from ksim_rl.objectives.estimator_options import check_options, normalizes
from ksim_rl.objectives.masked import standardized


@dataclass(frozen=True, kw_only=True)
class Signals:
    """The inputs of an advantage, all of one shape; ET stands for any batch dims, and dim `time_dim` >= 0 is time."""

    value_ET_t: Float[Tensor, "*batch 1"]
    value_ET_t_plus_1: Float[Tensor, "*batch 1"]
    reward_ET: Float[Tensor, "*batch 1"]
    done_ET: Bool[Tensor, "*batch 1"]
    terminated_ET: Bool[Tensor, "*batch 1"]
    time_dim: int

    def bootstrap(
        self, value_ET_t_plus_1: Float[Tensor, "*batch 1"], gamma: Float[Tensor, ""]
    ) -> Float[Tensor, "*batch 1"]:
        """Return gamma * value, and zero after a termination, whatever the value there."""
        # A where instead of a product, because zero times NaN is NaN.
        zero_ET = torch.zeros_like(value_ET_t_plus_1)
        return torch.where(self.terminated_ET, zero_ET, gamma * value_ET_t_plus_1)


class RolloutEstimator(ValueEstimatorBase):
    """Base of `GAE`, `TDLambda` and `VTrace`, each with the keys and the results of TorchRL's estimator of that name.

    The forward reads no tensor value on the host: it can be captured in a CUDA graph and compiled. The value after a
    step is V of the true next observation, which at a truncation is the last one of the episode, before the reset;
    after a termination it is zero. Gradients are not tracked. The `critic` (`value_network` for TorchRL) computes
    `state_value` and `("next", "state_value")` at each call; without one the data has them. It takes all env
    states in one batch dim. A recurrent critic needs batch dims [E, T]: it runs through the rollout from the state
    of the first step, and the value after a step is for the true next observation and the state after the step.

    A step whose reward or values are not finite gets a NaN advantage, so that `DatasetBuffer` removes it, and the
    recursion starts again before it: the steps that led there keep finite advantages, which bootstrap from the value at
    that step. A non-finite value after a termination does not matter. `normalize_advantage` shifts and scales the
    finite ones to mean 0 and standard deviation 1 over all env states, or divides by `min_advantage_std` where that is
    more (the default is TorchRL's). Time is the batch dim `time_dim`, whatever the names say; with None it is the dim
    named "time", or the last one. With `skip_existing` values that the data has are not computed again. Other options
    of TorchRL's are refused where they ask for something else than what is done here.
    """

    time_dim: int | None

    def __init__(
        self,
        *,
        gamma: float,
        critic: TensorDictModule | None = None,
        normalize_advantage: bool = False,
        min_advantage_std: float = 1e-4,
        time_dim: int | None = -1,
        skip_existing: bool | None = None,
        device: torch.device | str | None = None,
        **options: Any,
    ) -> None:
        value_network: TensorDictModule | None = options.pop("value_network", None)
        if critic is None:
            critic = value_network
        kind = str(type(self).__name__)
        check_options(kind, options)
        if skip_existing and critic is not None and carries_state(critic):
            raise ValueError(
                f"{kind}: skip_existing=True with a recurrent critic, whose states come along with its values: leave "
                "it out"
            )
        # The constants, such as gamma, are buffers that should lie where the critic does.
        if device is None and critic is not None:
            device = next((parameter.device for parameter in critic.parameters()), None)
        super().__init__(
            gamma=gamma,  # type: ignore[call-arg]
            value_network=critic,  # type: ignore[arg-type]
            time_dim=time_dim,  # type: ignore[call-arg]
            device=None if device is None else torch.device(device),
            **options,
        )
        self._skips = bool(skip_existing)
        self.normalize_advantage = normalize_advantage
        self.min_advantage_std = min_advantage_std

    @abstractmethod
    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return the advantages, the value targets, and which steps are finite: advantages elsewhere are ignored."""

    @dispatch  # type: ignore[arg-type]
    @torch.no_grad()
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
        time_dim: int | None = None,
    ) -> TensorDictBase:
        """Write `advantage`, `value_target` [..., 1] and the state values into `tensordict`, and return it.

        It has the critic's inputs at the root and under "next", and "reward", "done" and "terminated" under "next".
        `params` and `target_params` are of a functional critic, at the root and under "next". Raises ValueError where a
        value, the reward or a flag is missing, or their shapes differ.
        """
        # Values first, then the recursion over time, then the standardization of finite advantages.
        signals = self._signals(tensordict, params, target_params, self._resolved(time_dim, tensordict))
        adv_ET, target_ET, finite_ET = self._estimate(signals, tensordict)
        if self.normalize_advantage:
            adv_ET = standardized(adv_ET, finite_ET, lowest_std=self.min_advantage_std)
        # NaN marks the steps that the dataset has to remove.
        nan_ET = torch.full_like(adv_ET, torch.nan)
        tensordict.set(self.tensor_keys.advantage, torch.where(finite_ET, adv_ET, nan_ET))
        tensordict.set(self.tensor_keys.value_target, target_ET)
        return tensordict

    def _resolved(self, time_dim: int | None, tensordict: TensorDictBase) -> int:
        # The argument of a call goes before the dim given at construction.
        if time_dim is None:
            time_dim = self.time_dim
        if time_dim is None:
            names = list(tensordict.names) if tensordict.names is not None else []
            time_dim = names.index("time") if "time" in names else -1
        if not -tensordict.batch_dims <= time_dim < tensordict.batch_dims:
            raise ValueError(
                f"time_dim={time_dim}: the data has {tensordict.batch_dims} batch dims {tuple(tensordict.batch_size)}"
            )
        # Never negative, so that it holds for leaves with more dims than the batch.
        return time_dim % tensordict.batch_dims

    def _signals(
        self,
        tensordict: TensorDictBase,
        params: TensorDictBase | None,
        target_params: TensorDictBase | None,
        time_dim: int,
    ) -> Signals:
        keys = self.tensor_keys
        following: TensorDictBase = tensordict.get("next")
        critic: Any = self.value_network
        if critic is not None:
            # Values after a step come from the target critic, where TorchRL passes one.
            if target_params is None:
                next_params = params
            else:
                next_params = target_params
            # A recurrent critic runs through the rollout first: the values after each step need its states there.
            if carries_state(critic):
                tensordict.set(keys.value, self._unrolled_values(tensordict, params))
            elif not self._has_values(tensordict):
                tensordict.set(keys.value, self._state_values(tensordict, params, time_dim))
            if not self._has_values(following):
                following.set(keys.value, self._state_values(following, next_params, time_dim))
        signals = (keys.value, keys.reward, keys.done, keys.terminated)
        places = [keys.value, *(("next", key) for key in signals)]
        read: list[Any] = [tensordict.get(place, None) for place in places]
        # An env without "terminated" ends all its episodes by "done".
        if read[-1] is None:
            read[-1] = read[-2]
        # All signals must agree: shapes that differ by a dim could broadcast without an error.
        shapes: list[tuple[int, ...] | None] = []
        for signal in read:
            shapes.append(None if signal is None else tuple(signal.shape))
        if None in shapes or len(set(shapes)) != 1:
            got = ", ".join(f"{place!r} {shape}" for place, shape in zip(places, shapes, strict=True))
            raise ValueError(
                f"{type(self).__name__} needs these signals, all in one shape [*batch, 1]; got {got}"
            )
        names = ("value_ET_t", "value_ET_t_plus_1", "reward_ET", "done_ET", "terminated_ET")
        return Signals(**dict(zip(names, read, strict=True)), time_dim=time_dim)

    def _has_values(self, tensordict: TensorDictBase) -> bool:
        return self._skips and tensordict.get(self.tensor_keys.value, None) is not None

    def _state_values(
        self, tensordict: TensorDictBase, params: TensorDictBase | None, time_dim: int
    ) -> Tensor:
        critic = self.value_network
        assert isinstance(critic, TensorDictModule)
        # A recurrent critic, too, takes each element as one step here: it goes on from the state stored with it.
        with nullcontext() if params is None else params.to_module(critic), steps_of(critic):
            return self._in_rows(
                lambda rows: critic(rows).get(self.tensor_keys.value),
                tensordict.select(*critic.in_keys, strict=not carries_state(critic)),
                time_dim,
            )

    def _unrolled_values(self, tensordict: TensorDictBase, params: TensorDictBase | None) -> Tensor:
        """Return the values of a recurrent critic from the first step's state on, and leave its states under "next"."""
        critic = self.value_network
        assert isinstance(critic, TensorDictModule)
        with nullcontext() if params is None else params.to_module(critic), set_recurrent_mode(True):
            unrolled = critic(tensordict.select(*critic.in_keys))
        tensordict.get("next").update(unrolled.get("next"))
        return unrolled.get(self.tensor_keys.value)

    def _in_rows(
        self, network: Callable[[TensorDictBase], Tensor], inputs: TensorDictBase, time_dim: int
    ) -> Tensor:
        """Return the outputs of `network` for `inputs` in one batch dim, with the batch dims of `inputs` again."""
        if inputs.batch_dims < 2:
            return network(inputs)
        # Rows are taken in the order of the memory, which saves a copy of all observations.
        leaf = next(iter(inputs.values(include_nested=True, leaves_only=True)))
        if leaf.movedim(time_dim, 0).is_contiguous():
            first = time_dim
        else:
            first = 0
        last_dim = inputs.batch_dims - 1
        rows = inputs.apply(
            lambda leaf: leaf.movedim(first, 0).flatten(0, last_dim), batch_size=[inputs.numel()]
        )
        # Rows go back to the batch dims in the order in which they were taken.
        shape = list(inputs.batch_size)
        shape.insert(0, shape.pop(first))
        return network(rows).unflatten(0, shape).movedim(0, first)

    def value_estimate(
        self,
        tensordict: TensorDictBase,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
        time_dim: int | None = None,
        **kwargs: Any,
    ) -> Float[Tensor, "*batch 1"]:
        """Return the value target [..., 1] without writing into `tensordict`."""
        copy = tensordict.copy()
        self(copy, params=params, target_params=target_params, time_dim=time_dim)
        return copy.get(self.tensor_keys.value_target)


def carries_state(network: TensorDictModuleBase) -> bool:
    """Whether a network is recurrent: it writes under "next" the state that it reads at the root one step later."""
    return any(isinstance(key, tuple) and key[0] == "next" for key in network.out_keys)


def steps_of(network: TensorDictModuleBase) -> AbstractContextManager[None]:
    """Let a recurrent network take each element of a batch as one step, even inside a loss."""
    # Not for others: the compiler cannot follow it.
    if carries_state(network):
        return set_recurrent_mode(False)
    return nullcontext()


def discounted_sum(
    term_ET: Float[Tensor, "*batch 1"], discount_ET: Float[Tensor, "*batch 1"], *, time_dim: int
) -> Float[Tensor, "*batch 1"]:
    """Return x with x_t = term_t + discount_t x_{t+1}; x after the last step is zero."""
    # Time first, and split into its steps: a loop over T small tensors, [*batch, 1] each.
    terms, discounts = (leaf.movedim(time_dim, 0).unbind(0) for leaf in (term_ET, discount_ET))
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
    estimate: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]], lmbda: Tensor, value_lmbda: float | None
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
        super().__init__(lmbda=lmbda, normalize_advantage=normalizes(normalize_advantage, options), **options)
        self._value_lmbda = value_lmbda

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
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

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        # G_{t+1} is V_{t+1} + A_{t+1}: TD errors with this mean of both values after a step sum up to G_t - V_t.
        after_ET = signals.value_ET_t_plus_1
        # A value that is not finite must not spoil the step before it, whose mean would be NaN.
        following_ET = _shifted(signals.value_ET_t.nan_to_num(0.0, 0.0, 0.0), after_ET, signals.time_dim)

        def estimate(lmbda: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            mean_ET = torch.where(signals.done_ET, after_ET, after_ET + lmbda * (following_ET - after_ET))
            return _discounted_errors(replace(signals, value_ET_t_plus_1=mean_ET), self.gamma, lmbda)

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
            actor_network=actor, normalize_advantage=normalizes(normalize_advantage, options), **options
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
        return list(dict.fromkeys([*read, *(("next", key) for key in [*observed, *flags])]))

    def _estimate(self, signals: Signals, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
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
        return rho_ET * (signals.reward_ET + bootstrap_ET - signals.value_ET_t), target_ET, finite_ET

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
    return torch.cat((leaf.narrow(time_dim, 1, length - 1), last.narrow(time_dim, length - 1, 1)), time_dim)
