"""The base of the advantage estimators: it computes values for a rollout, and standardizes advantages."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value import ValueEstimatorBase

from ksim_rl.objectives.estimator_options import check_options
from ksim_rl.objectives.masked import standardized

# Numbers that a network reads at a time, as no gradient is tracked here: 1 GiB in float32. Vectors of a rollout are
# fewer; pictures, which are bytes until then, may be a hundred times as many.
MOST_NUMBERS = 2**28

Output = TypeVar("Output", Tensor, TensorDictBase)


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
    of TorchRL's are refused where they ask for anything else.
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
    def _estimate(
        self, signals: Signals, tensordict: TensorDictBase
    ) -> tuple[Tensor, Tensor, Tensor]:
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
        signals = self._signals(
            tensordict, params, target_params, self._resolved(time_dim, tensordict)
        )
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
            got = ", ".join(
                f"{place!r} {shape}" for place, shape in zip(places, shapes, strict=True)
            )
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
        with (
            nullcontext() if params is None else params.to_module(critic),
            set_recurrent_mode(True),
        ):
            # Without what it reads, so that no pictures are copied.
            unrolled = _in_pieces(
                lambda piece: critic(piece).select(self.tensor_keys.value, "next"),
                tensordict.select(*critic.in_keys),
            )
        tensordict.get("next").update(unrolled.get("next"))
        return unrolled.get(self.tensor_keys.value)

    def _in_rows(
        self, network: Callable[[TensorDictBase], Tensor], inputs: TensorDictBase, time_dim: int
    ) -> Tensor:
        """Return the outputs of `network` for `inputs` in one batch dim, with the batch dims of `inputs` again."""
        if inputs.batch_dims < 2:
            return _in_pieces(network, inputs)
        # Rows are taken in the order of the memory, which saves a copy of all observations.
        # As a list: compiled by torch 2.14, a generator that is left half read ends in an error.
        leaf = list(inputs.values(include_nested=True, leaves_only=True))[0]
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
        return _in_pieces(network, rows).unflatten(0, shape).movedim(0, first)

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


def _in_pieces(network: Callable[[TensorDictBase], Output], inputs: TensorDictBase) -> Output:
    """Return the output of `network`, which reads parts of the first batch dim, of at most `MOST_NUMBERS` numbers each.

    Its elements, rows or envs with all of their steps, are read each by itself, so that only rounding differs; a user's
    encoder with batch statistics takes them from each part.
    """
    numbers = 0
    for leaf in inputs.values(include_nested=True, leaves_only=True):
        numbers += leaf[0].numel()
    size = max(1, MOST_NUMBERS // max(1, numbers))
    pieces = inputs.split(size)
    # The common case, without a copy.
    if len(pieces) == 1:
        return network(inputs)
    # It joins tensordicts, too, which its stub does not say.
    joined: Any = torch.cat([network(piece) for piece in pieces])
    return joined


def carries_state(network: TensorDictModuleBase) -> bool:
    """Whether a network is recurrent: it writes under "next" the state that it reads at the root one step later."""
    return any(isinstance(key, tuple) and key[0] == "next" for key in network.out_keys)


def steps_of(network: TensorDictModuleBase) -> AbstractContextManager[None]:
    """Let a recurrent network take each element of a batch as one step, even inside a loss."""
    # Not for others: the compiler cannot follow it.
    if carries_state(network):
        return set_recurrent_mode(False)
    return nullcontext()
