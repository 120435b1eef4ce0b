"""This module has what the estimators of advantages share: state values of a rollout, and a recursion back in time."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value import ValueEstimatorBase

from ksim_rl.objectives.masked import standardized


@dataclass(frozen=True, kw_only=True)
class Signals:
    """What an advantage is made of, all of one shape; ET stands for whatever the batch dims are.

    The value after the step is that of the true next observation; `time_dim` is the batch dim that is time, >= 0.
    """

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
    """Base of `GAE`, `TDLambda` and `VTrace`, each beside TorchRL's estimator of that name: its keys and its results.

    The forward reads no tensor value on the host: it can be captured in a CUDA graph and compiled. The value after a
    step is V of the true next observation, which at a truncation is the last one of the episode, before the reset;
    after a termination it is zero. Gradients are not tracked. `state_value` and `("next", "state_value")` are always
    computed anew when there is a critic.

    A step whose reward or values are not finite gets a NaN advantage, so that `DatasetBuffer` removes it, and the
    recursion starts anew before it: the steps that led there keep finite advantages, which bootstrap from the value at
    that step. A non-finite value after a termination does not matter.

    A recurrent critic needs batch dims [E, T]: it runs through the rollout from the state of the first step, and the
    value after a step is that of the true next observation and the state after the step.

    Args:
        gamma: discount per step, in [0, 1]. The `lmbda` of its subclasses is the weight of longer returns, in [0, 1].
        critic: any TensorDict module that writes `state_value` [..., 1]; None reads the values from the data.
            `value_network` is TorchRL's name for it.
        normalize_advantage: shift and scale the finite advantages to mean 0 and standard deviation 1 over all
            env states.
        time_dim: the batch dim that is time, whatever the names say; -1 is the last batch dim.
        flatten: give the critic all env states in one batch dim; False keeps the batch dims, e.g. for a
            recurrent one.
        device: of gamma and lmbda; None takes that of the critic.
        **options: of TorchRL's estimator.
    """

    time_dim: int | None

    def __init__(
        self,
        *,
        gamma: float,
        critic: TensorDictModule | None = None,
        normalize_advantage: bool = False,
        time_dim: int = -1,
        flatten: bool = True,
        device: torch.device | str | None = None,
        value_network: TensorDictModule | None = None,
        **options: Any,
    ) -> None:
        critic = value_network if critic is None else critic
        if device is None and critic is not None:
            device = next((parameter.device for parameter in critic.parameters()), None)
        super().__init__(
            gamma=gamma,  # type: ignore[call-arg]
            value_network=critic,  # type: ignore[arg-type]
            time_dim=time_dim,  # type: ignore[call-arg]
            device=None if device is None else torch.device(device),
            **options,
        )
        self.flatten, self.normalize_advantage = flatten, normalize_advantage

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

        Args:
            tensordict: batch dims with time among them, e.g. `["E","T"]`; what the critic reads at the root
                and under "next", and "reward", "done", "terminated" under "next".
            params, target_params: parameters of a functional critic, at the root and under "next".
            time_dim: overrides that of the constructor.

        Raises:
            ValueError: if a value, the reward or a flag is missing, or their shapes differ.
        """
        signals = self._signals(tensordict, params, target_params, self._resolved(time_dim, tensordict))
        adv_ET, target_ET, finite_ET = self._estimate(signals, tensordict)
        if self.normalize_advantage:
            # The bound is that of TorchRL.
            adv_ET = standardized(adv_ET, finite_ET, lowest_std=1e-4)
        nan_ET = torch.full_like(adv_ET, torch.nan)
        tensordict.set(self.tensor_keys.advantage, torch.where(finite_ET, adv_ET, nan_ET))
        tensordict.set(self.tensor_keys.value_target, target_ET)
        return tensordict

    def _resolved(self, time_dim: int | None, tensordict: TensorDictBase) -> int:
        if time_dim is None:
            assert self.time_dim is not None
            time_dim = self.time_dim
        if not -tensordict.batch_dims <= time_dim < tensordict.batch_dims:
            raise ValueError(
                f"time_dim={time_dim}: the data has {tensordict.batch_dims} batch dims {tuple(tensordict.batch_size)}"
            )
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
            next_params = params if target_params is None else target_params
            if carries_state(critic):
                tensordict.set(keys.value, self._unrolled_values(tensordict, params))
            else:
                tensordict.set(keys.value, self._state_values(tensordict, params, time_dim))
            following.set(keys.value, self._state_values(following, next_params, time_dim))
        read: list[Any] = [tensordict.get(keys.value, None)]
        read += [following.get(key, None) for key in (keys.value, keys.reward, keys.done)]
        read.append(following.get(keys.terminated, read[-1]))
        shapes = [None if signal is None else tuple(signal.shape) for signal in read]
        if None in shapes or len(set(shapes)) != 1:
            raise ValueError(
                f"{type(self).__name__} needs these signals, all in one shape [*batch, 1]; got "
                f"{keys.value!r} {shapes[0]}, ('next', {keys.value!r}) {shapes[1]}, "
                f"('next', {keys.reward!r}) {shapes[2]}, ('next', {keys.done!r}) {shapes[3]}, "
                f"('next', {keys.terminated!r}) {shapes[4]}"
            )
        names = ("value_ET_t", "value_ET_t_plus_1", "reward_ET", "done_ET", "terminated_ET")
        return Signals(**dict(zip(names, read, strict=True)), time_dim=time_dim)

    def _state_values(
        self, tensordict: TensorDictBase, params: TensorDictBase | None, time_dim: int
    ) -> Tensor:
        critic = self.value_network
        assert isinstance(critic, TensorDictModule)
        # A recurrent critic, too, takes each element as one step here: it goes on from the state that lies beside it.
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
        """Return what `network` gives for `inputs` in one batch dim, with the batch dims of `inputs` again."""
        if not self.flatten or inputs.batch_dims < 2:
            return network(inputs)
        # Rows are taken in the order of the memory, which saves a copy of all observations.
        leaf = next(iter(inputs.values(include_nested=True, leaves_only=True)))
        first = time_dim if leaf.movedim(time_dim, 0).is_contiguous() else 0
        last_dim = inputs.batch_dims - 1
        rows = inputs.apply(
            lambda leaf: leaf.movedim(first, 0).flatten(0, last_dim), batch_size=[inputs.numel()]
        )
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
    """Whether a network is recurrent: it writes under "next" what it reads at the root one step later."""
    return any(isinstance(key, tuple) and key[0] == "next" for key in network.out_keys)


def steps_of(network: TensorDictModuleBase) -> AbstractContextManager[Any]:
    """Let a recurrent network take each element of a batch as one step, even inside a loss."""
    # Not for others: the compiler cannot follow it.
    return set_recurrent_mode(False) if carries_state(network) else nullcontext()


def discounted_sum(
    term_ET: Float[Tensor, "*batch 1"],
    discount_ET: Float[Tensor, "*batch 1"],
    *,
    time_dim: int,
    last_E: Float[Tensor, "*batch_without_time 1"] | None = None,
) -> Float[Tensor, "*batch 1"]:
    """Return x with x_t = term_t + discount_t x_{t+1}; x after the last step is `last_E`, or zero."""
    terms, discounts = (leaf.movedim(time_dim, 0).unbind(0) for leaf in (term_ET, discount_ET))
    total = torch.zeros_like(terms[0]) if last_E is None else last_E
    totals = []
    for term_t, discount_t in zip(reversed(terms), reversed(discounts), strict=True):
        total = torch.addcmul(term_t, discount_t, total)
        totals.append(total)
    return torch.stack(totals[::-1]).movedim(0, time_dim)
