"""The dataset of one RL update, and the arithmetic between its size, minibatches and rollouts."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int64
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.data.replay_buffers import Sampler

from ksim_rl import dims
from ksim_rl.checked import Checked, Count, WholeNumber
from ksim_rl.checks import check_count, naming
from ksim_rl.data.dataset_storage import MASK_KEY, DatasetStorage, DatasetWriter
from ksim_rl.data.epoch_sampler import BURN_IN_KEY, EpochSampler, SampleInfo, SequenceSampler


@dataclass(frozen=True, kw_only=True)
class DatasetCfg(Checked):
    """How many env states one RL update uses, and in how many gradient steps an epoch splits them.

    With several ranks all sizes are per rank.

    Attributes:
        num_env_states_per_minibatch: env states of a gradient step.
        num_minibatches: gradient steps of an epoch.
        sequence_length: successive steps of an env on which recurrent networks learn; None for the whole rollout.
        burn_in: steps before a sequence that renew its first state; with 0 it is the stored one.
        shards: one process draws its minibatches from so many equal parts of its envs, as so many ranks would.
    """

    num_env_states_per_minibatch: Count
    num_minibatches: Count
    sequence_length: Count | None = None
    burn_in: WholeNumber = 0
    shards: Count = 1

    @property
    def num_env_states(self) -> int:
        """D, the size of the dataset."""
        return self.num_env_states_per_minibatch * self.num_minibatches

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of a dataset: observation, action and reward."""
        return {("num_env_states_per_minibatch", "num_minibatches"): 3 * self.num_env_states}

    def rollout_length(self, num_envs: int) -> int:
        """Return T for so many parallel environments; see `rollout_length`. Envs and minibatches have equal shards."""
        size = self.num_env_states_per_minibatch
        # Each shard has as many envs, and as many env states in each minibatch.
        if num_envs % self.shards or size % self.shards:
            raise ValueError(
                f"shards={self.shards} does not divide num_envs={num_envs} and num_env_states_per_minibatch={size}: "
                f"use a divisor of {math.gcd(num_envs, size)}"
            )
        return rollout_length(self.num_env_states_per_minibatch, self.num_minibatches, num_envs)

    def with_rollout_length(self, length: int, num_envs: int) -> "DatasetCfg":
        """Return as many minibatches, of the size that makes T `length`; a ValueError where there is none."""
        # D = T * E must be M whole minibatches.
        size, rest = divmod(length * num_envs, self.num_minibatches)
        if rest:
            step = self.num_minibatches // math.gcd(num_envs, self.num_minibatches)
            raise ValueError(
                f"collector.rollout_length={length} * num_envs={num_envs} = {length * num_envs} env states are not "
                f"data.num_minibatches={self.num_minibatches} equal parts: "
                f"collector.rollout_length={_near_multiples(length, step)} are"
            )
        with naming(f"collector.rollout_length={length}"):
            return replace(self, num_env_states_per_minibatch=size)


def rollout_length(num_env_states_per_minibatch: int, num_minibatches: int, num_envs: int) -> int:
    """Return T = D / num_envs, the steps of each env for a dataset; a ValueError has the nearest values that work."""
    check_count("num_env_states_per_minibatch", num_env_states_per_minibatch)
    check_count("num_minibatches", num_minibatches)
    check_count("num_envs", num_envs)
    num_env_states = num_env_states_per_minibatch * num_minibatches
    if num_env_states % num_envs == 0:
        return num_env_states // num_envs

    # n * M is a multiple of E exactly when n is a multiple of E / gcd(E, M).
    per_minibatch = _near_multiples(
        num_env_states_per_minibatch, num_envs // math.gcd(num_envs, num_minibatches)
    )
    minibatches = _near_multiples(
        num_minibatches, num_envs // math.gcd(num_envs, num_env_states_per_minibatch)
    )
    envs = _near_divisors(num_env_states_per_minibatch, num_minibatches, num_envs)
    raise ValueError(
        f"num_env_states_per_minibatch={num_env_states_per_minibatch} * num_minibatches={num_minibatches} = "
        f"{num_env_states} env states cannot be shared equally by num_envs={num_envs}: each env would take "
        f"{num_env_states / num_envs:.4g} steps. Change one of them: "
        f"num_env_states_per_minibatch={per_minibatch}, num_minibatches={minibatches} or num_envs={envs}"
    )


def _near_multiples(value: int, factor: int) -> str:
    # The neighbours on either side, for the message of the error.
    below = value // factor * factor
    return " or ".join(str(number) for number in (below, below + factor) if number > 0)


def _near_divisors(first: int, second: int, value: int) -> str:
    # A divisor of a product is one of a divisor of each factor: far fewer are tried than for the product.
    divisors = {one * other for one in _divisors(first) for other in _divisors(second)}
    below = max((divisor for divisor in divisors if divisor < value), default=None)
    above = min((divisor for divisor in divisors if divisor > value), default=None)
    return " or ".join(str(divisor) for divisor in (below, above) if divisor is not None)


def _divisors(number: int) -> set[int]:
    # They come in pairs around the square root.
    small = [divisor for divisor in range(1, math.isqrt(number) + 1) if number % divisor == 0]
    return {*small, *(number // divisor for divisor in small)}


class DatasetBuffer(ReplayBuffer):
    """Holds D env states and yields minibatches of B of them.

    Storage, sampler and writer are TorchRL parts. `extend` takes a whole dataset, `["E","T"]` or `["D"]`, and copies it
    into storage whose addresses never change; `sample` gives the next minibatch `["B"]`; `epoch` gives
    `num_minibatches` of them that cover the dataset exactly once; `all` gives the dataset `["D"]`. None of them makes a
    host sync, so whole epochs can be captured in a CUDA graph. Rows with a non-finite element are removed, masked and
    counted: see `DatasetStorage`. Stored are the leaves at `keys`, None for all; `seed` is of the env states' order.
    """

    def __init__(
        self,
        cfg: DatasetCfg,
        *,
        keys: Sequence[NestedKey] | None = None,
        seed: int = 0,
        sampler: Sampler | None = None,
        device: torch.device | str = "auto",
    ) -> None:
        # TorchRL's buffer wraps its storage in its own methods; this one is read directly as well.
        self._dataset = DatasetStorage(cfg.num_env_states, device=device)
        if sampler is None:
            sampler = EpochSampler(
                seed=seed, shards=cfg.shards, num_minibatches=cfg.num_minibatches
            )
        super().__init__(
            storage=self._dataset,
            sampler=sampler,
            writer=DatasetWriter(),
            batch_size=cfg.num_env_states_per_minibatch,
        )
        self.cfg = cfg
        self._keys = None if keys is None else list(keys)

    @property
    def non_finite_count(self) -> Int64[Tensor, ""]:
        """Rows removed so far because an element was not finite, on the device."""
        return self._dataset.non_finite_count

    def extend(
        self, data: TensorDictBase, *, update_priority: bool | None = None
    ) -> Int64[Tensor, " D"]:
        """Replace the dataset by `data`, exactly D env states in env-major order, and return the indices written."""
        size = self.cfg.num_env_states
        if data.numel() != size:
            raise ValueError(
                f"the data has {data.numel()} env states (batch_size {tuple(data.batch_size)}), the dataset holds "
                f"num_env_states_per_minibatch={self.cfg.num_env_states_per_minibatch} * "
                f"num_minibatches={self.cfg.num_minibatches} = {size}: collect rollouts of {size} / num_envs steps"
            )
        if self._keys is not None:
            missing = [key for key in self._keys if data.get(key, None) is None]
            if missing:
                raise ValueError(
                    f"the data lacks {missing}; it has {sorted(map(str, data.keys(True, True)))}"
                )
            # Leaves that no loss reads are not copied; a mask of the data is kept where there is one.
            data = data.select(*self._keys, ("collector", "mask"), strict=False)
        # Before anything is written, so that a refused rollout leaves the dataset as it was.
        if isinstance(self.sampler, SequenceSampler):
            self.sampler.begin(data.batch_size, batch_size=self.cfg.num_env_states_per_minibatch)
        return super().extend(data, update_priority=update_priority)

    def sample(
        self, batch_size: int | None = None, return_info: bool = False
    ) -> TensorDictBase | tuple[TensorDictBase, SampleInfo]:
        """Return the next minibatch `["B"]` of the present epoch, with the info dict if `return_info`.

        With a `SequenceSampler` it is `["B","T"]`: whole sequences, which begin with their burn-in if there is one.
        """
        # The info has the burn-in flags, whether the caller wants it or not.
        data, info = super().sample(batch_size, return_info=True)
        data = _labelled(data, info)
        if return_info:
            return (data, info)
        return data

    def epoch(self) -> Iterator[TensorDictBase]:
        """Yield `num_minibatches` minibatches, as of `sample`, that cover the dataset exactly once, in a new order."""
        # A minibatch left over from an epoch that was not finished must not begin this one.
        if isinstance(self.sampler, EpochSampler):
            self.sampler.restart()
        # One gather for all minibatches: a quarter of the kernels, and each minibatch is a contiguous slice.
        data, info = self._sample(self.cfg.num_env_states)
        data = _labelled(data, info)
        yield from data.split(data.batch_size[0] // self.cfg.num_minibatches)

    def epoch_orders(self, count: int) -> Int64[Tensor, "K D"]:
        """Begin `count` epochs of an `EpochSampler`; return their orders instead of minibatches, on the device."""
        if type(self.sampler) is not EpochSampler:
            raise TypeError(
                f"a {type(self.sampler).__name__} has no order of single env states: use epoch()"
            )
        return self.sampler.epoch_orders(
            count, self.cfg.num_env_states, device=self.non_finite_count.device
        )

    def all(self) -> TensorDictBase:
        """Return the dataset `["D"]`: views of the storage, which the next `extend` overwrites."""
        return dims.name(self._dataset.get(slice(None)), dims.D)


def _labelled(data: TensorDictBase, info: SampleInfo) -> TensorDictBase:
    """Name the dims of a sample `["B"]` or `["B","T"]`, and write into it the burn-in flags of its sampler."""
    if BURN_IN_KEY in info:
        data.set(BURN_IN_KEY, info[BURN_IN_KEY])
        # Steps of the burn-in take no part in a loss.
        data.set(MASK_KEY, data.get(MASK_KEY) & info[MASK_KEY])
    return dims.name(data, *(dims.B, dims.T)[: data.batch_dims])
