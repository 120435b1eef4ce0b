"""Generalized advantage estimation without host syncs."""

from contextlib import nullcontext
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor
from torchrl.objectives import value


class GAE(value.GAE):
    """Computes `advantage` and `value_target` of a rollout (Schulman et al., arXiv 1506.02438).

    It is TorchRL's `GAE` with the same keys and results, with a forward that reads no tensor value on the
    host: it can be captured in a CUDA graph and compiled. The value after a step is V of the true next
    observation, which at a truncation is the last one of the episode, before the reset; after a termination
    it is zero. Gradients are not tracked. `state_value` and `("next", "state_value")` are always computed
    anew when there is a critic.

    A step whose reward or values are not finite gets a NaN advantage, so that `DatasetBuffer` removes it, and
    the recursion starts anew before it: the steps that led there keep finite, one-step-bootstrapped
    advantages. A non-finite value after a termination does not matter.

    Args:
        gamma: discount per step, in [0, 1].
        lmbda: weight of longer returns, in [0, 1].
        critic: any TensorDict module that writes `state_value` [..., 1]; None reads the values from the data.
        normalize_advantage: shift and scale the finite advantages to mean 0 and standard deviation 1 over all
            env states.
        time_dim: the batch dim that is time, whatever the names say; -1 is the last batch dim.
        flatten: give the critic all env states in one batch dim; False keeps the batch dims, e.g. for a
            recurrent one.
        device: of gamma and lmbda; None takes that of the critic.
    """

    def __init__(
        self,
        *,
        gamma: float,
        lmbda: float,
        critic: TensorDictModule | None = None,
        normalize_advantage: bool = False,
        time_dim: int = -1,
        flatten: bool = True,
        device: torch.device | str | None = None,
        value_network: TensorDictModule | None = None,
    ) -> None:
        critic = value_network if critic is None else critic
        if device is None and critic is not None:
            device = next((parameter.device for parameter in critic.parameters()), None)
        super().__init__(
            gamma=gamma,
            lmbda=lmbda,
            value_network=critic,
            average_gae=normalize_advantage,
            vectorized=False,
            time_dim=time_dim,
            device=None if device is None else torch.device(device),
        )
        self.flatten = flatten

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
                and under "next", and "reward", "done", "terminated" under "next". Its memory may be
                time-major.
            params, target_params: parameters of a functional critic, at the root and under "next".
            time_dim: overrides that of the constructor.

        Raises:
            ValueError: if a value, the reward or a flag is missing, or their shapes differ.
        """
        time_dim = self._resolve_time_dim(time_dim, tensordict)
        keys = self.tensor_keys
        following: TensorDictBase = tensordict.get("next")
        if self.value_network is not None:
            tensordict.set(keys.value, self._state_values(tensordict, params, time_dim))
            next_params = params if target_params is None else target_params
            following.set(keys.value, self._state_values(following, next_params, time_dim))
        signals: list[Tensor | None] = [
            tensordict.get(keys.value, None),
            following.get(keys.value, None),
            following.get(keys.reward, None),
            following.get(keys.done, None),
        ]
        shapes = [None if signal is None else tuple(signal.shape) for signal in signals]
        if None in shapes or len(set(shapes)) != 1:
            raise ValueError(
                "GAE needs these signals, all in one shape [*batch, 1]; got "
                f"{keys.value!r} {shapes[0]}, ('next', {keys.value!r}) {shapes[1]}, "
                f"('next', {keys.reward!r}) {shapes[2]}, ('next', {keys.done!r}) {shapes[3]}"
            )
        terminated = following.get(keys.terminated, signals[3])
        advantage, value_target = self._estimate(*signals, terminated, time_dim=time_dim)  # type: ignore[arg-type]
        tensordict.set(keys.advantage, advantage)
        tensordict.set(keys.value_target, value_target)
        return tensordict

    def _resolve_time_dim(self, time_dim: int | None, tensordict: TensorDictBase) -> int:
        if time_dim is None:
            assert self.time_dim is not None
            time_dim = self.time_dim
        if not -tensordict.batch_dims <= time_dim < tensordict.batch_dims:
            raise ValueError(
                f"time_dim={time_dim}: the data has {tensordict.batch_dims} batch dims {tuple(tensordict.batch_size)}"
            )
        return time_dim % tensordict.batch_dims

    def _estimate(
        self,
        state_value: Tensor,
        next_value: Tensor,
        reward: Tensor,
        done: Tensor,
        terminated: Tensor,
        *,
        time_dim: int,
    ) -> tuple[Tensor, Tensor]:
        # A where instead of a product, because zero times NaN is NaN.
        bootstrap = torch.where(terminated, torch.zeros_like(next_value), self.gamma * next_value)
        delta = reward + bootstrap - state_value
        finite = delta.isfinite()
        delta_T = torch.where(finite, delta, torch.zeros_like(delta)).movedim(time_dim, 0).unbind(0)
        discount_T = ((finite & ~done) * (self.gamma * self.lmbda)).movedim(time_dim, 0).unbind(0)

        advantage = torch.zeros_like(delta_T[0])
        advantages = []
        for delta_t, discount_t in zip(reversed(delta_T), reversed(discount_T), strict=True):
            advantage = torch.addcmul(delta_t, discount_t, advantage)
            advantages.append(advantage)
        advantage = torch.stack(advantages[::-1]).movedim(0, time_dim)
        value_target = advantage + state_value
        if self.average_gae:
            advantage = _normalize(advantage, finite)
        return torch.where(finite, advantage, torch.full_like(advantage, torch.nan)), value_target

    def _state_values(
        self, tensordict: TensorDictBase, params: TensorDictBase | None, time_dim: int
    ) -> Tensor:
        critic = self.value_network
        assert critic is not None
        inputs = tensordict.select(*critic.in_keys)
        with nullcontext() if params is None else params.to_module(critic):
            if not self.flatten or inputs.batch_dims < 2:
                return critic(inputs).get(self.tensor_keys.value)
            # Rows are taken in the order of the memory, which saves a copy of all observations.
            leaf = next(iter(inputs.values(include_nested=True, leaves_only=True)))
            first = time_dim if leaf.movedim(time_dim, 0).is_contiguous() else 0
            last_dim = inputs.batch_dims - 1
            flat = inputs.apply(
                lambda leaf: leaf.movedim(first, 0).flatten(0, last_dim), batch_size=[inputs.numel()]
            )
            values = critic(flat).get(self.tensor_keys.value)
            shape = list(inputs.batch_size)
            shape.insert(0, shape.pop(first))
            return values.unflatten(0, shape).movedim(0, first)

    def value_estimate(
        self,
        tensordict: TensorDictBase,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
        time_dim: int | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return the value target [..., 1] without writing into `tensordict`."""
        copy = tensordict.copy()
        self(copy, params=params, target_params=target_params, time_dim=time_dim)
        return copy.get(self.tensor_keys.value_target)


def _normalize(advantage: Tensor, finite: Tensor) -> Tensor:
    """Shift and scale to mean 0 and standard deviation 1 over the elements that `finite` marks."""
    count = finite.sum()
    zero = torch.zeros_like(advantage)
    mean = torch.where(finite, advantage, zero).sum() / count.clamp_min(1)
    error = advantage - mean
    variance = torch.where(finite, error, zero).square().sum() / (count - 1).clamp_min(1)
    # The bound is TorchRL's: advantages that are all alike stay near zero.
    return error / variance.sqrt().clamp_min(1e-4)
