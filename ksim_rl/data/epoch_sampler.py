"""Samples env states, or sequences of them, without replacement, in an order that stays on the device."""

import json
from pathlib import Path
from typing import TypeAlias

import torch
from jaxtyping import Int64, Shaped
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ksim_rl.data.dataset_storage import MASK_KEY
from ksim_rl.device import random
from ksim_rl.device.state_tree import State, number
from ksim_rl.files.reading import read_bytes
from ksim_rl.files.writing import write_whole

_STREAM = random.stream_id("data.epoch_sampler")

MOST_STATE_BYTES = 10_000


# Which entries of a storage are meant: their numbers, or one tensor of numbers per dim.
Entries: TypeAlias = Int64[Tensor, "*entries"] | tuple[Int64[Tensor, "*?entries"], ...] | int
# Facts that a sampler gives about a sample, by key.
SampleInfo: TypeAlias = dict[NestedKey, Shaped[Tensor, "*?leaf"]]


class EpochSampler(Sampler):
    """Yields every stored env state once per epoch, in a new random order each epoch, or as stored without `shuffle`.

    A drop-in for TorchRL's `SamplerWithoutReplacement` in any replay buffer. The order is a counter-based draw, so it
    needs no generator, makes no host sync, can be captured in a CUDA graph (the epoch counter is a device tensor;
    capture whole epochs), and resumes from four integers.

    With `shards`, it draws as so many ranks would: the elements are so many equal parts, one after the other, and each
    of the `num_minibatches` of an epoch has as many elements of each.
    """

    # Whether the last minibatch was the last of its epoch; iterating over the buffer stops there.
    ran_out: bool = False  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(
        self,
        *,
        seed: int = 0,
        shuffle: bool = True,
        drop_last: bool = False,
        shards: int = 1,
        num_minibatches: int = 1,
    ) -> None:
        self.seed = seed
        self.shuffle = shuffle
        self.drop_last = drop_last
        self.shards = shards
        self.num_minibatches = num_minibatches
        self._size = self._position = self._first_epoch = 0
        # Device tensors: epochs started so far, and the order of the present one.
        self._epoch: Tensor | None = None
        self._order_D: Tensor | None = None

    def set_seed(self, seed: int) -> None:
        """Start again with another seed, at epoch 0. Keeps the counter's address."""
        self.seed = seed
        self._empty()
        self._first_epoch = 0
        if self._epoch is not None:
            self._epoch.zero_()

    def extend(self, index: Entries) -> None:
        """Start a new epoch, because the data is new."""
        self.restart()

    def restart(self) -> None:
        """Leave the present epoch: the next sample is the first of a new one."""
        self._position = 0
        self.ran_out = False

    def sample(self, storage: Storage, batch_size: int) -> tuple[Entries, SampleInfo]:
        """Return the indices of the next minibatch [B] and an empty info dict."""
        size = stored(storage)
        if self.drop_last and batch_size > size:
            raise ValueError(
                f"batch_size={batch_size} exceeds the {size} stored elements and drop_last=True: "
                "nothing could be sampled; use a smaller batch_size or drop_last=False"
            )
        # A slice of the order, which is on the device of the storage already.
        index = self._next_part(
            size, batch_size, torch.device(getattr(storage, "device", None) or "cpu")
        )
        # TorchRL indexes storages of several dims by a tuple.
        if storage.ndim > 1:
            index = torch.unravel_index(index, storage.shape)
        return index, {}

    def epoch_orders(self, count: int, size: int, *, device: torch.device) -> Int64[Tensor, "K D"]:
        """Begin `count` epochs and return their orders of `range(size)`, as `sample` would give them in parts."""
        self.restart()
        self._size = size
        if self._epoch is None or self._epoch.device != device:
            self._epoch = torch.full((), self._first_epoch, dtype=torch.int64, device=device)
        # The counter on the device keys the draws, so that a replayed graph draws new orders each time.
        orders_KD = self._orders(self._epoch + torch.arange(count, device=device), size)
        # Without shuffling all orders are the same, and there is nothing to count.
        self._epoch.add_(count * self.shuffle)
        return orders_KD

    def _next_part(self, size: int, batch_size: int, device: torch.device) -> Tensor:
        """Return the next `batch_size` elements of the epoch's order of `range(size)`, on the device."""
        # Another size, or the end of the order: a new epoch begins.
        if size != self._size or self._position == 0:
            self._order_D = self.epoch_orders(1, size, device=device)[0]
        assert self._order_D is not None
        index = self._order_D[self._position : self._position + batch_size]
        self._position += batch_size
        left = size - self._position
        # TorchRL's iteration over a buffer reads this flag, and how many batches remain.
        self.ran_out = left <= 0 or (self.drop_last and left < batch_size)
        if self.ran_out:
            self._position = 0
        if self.drop_last:
            self._remaining_batches = left // batch_size
        else:
            self._remaining_batches = -(-left // batch_size)
        return index

    def _orders(self, epochs: Tensor, size: int) -> Tensor:
        """Return the orders of epochs: random ones unless `shuffle` is off, minibatch by minibatch."""
        if not self.shuffle:
            orders_KD = torch.arange(size, device=epochs.device).expand(len(epochs), size)
        elif size % self.shards:
            raise ValueError(
                f"{size} elements are no whole number for each of {self.shards} shards"
            )
        else:
            # A permutation for each shard and epoch, of elements within the shard.
            keys = random.row_keys(epochs.new_full((), self.seed), _STREAM, epochs, self.shards)
            orders_KD = random.permutations(keys, size // self.shards).view(-1, size)
        if self.shards == 1:
            return orders_KD
        # From shard by shard to minibatch by minibatch: [K, shards, M, B / shards] to [K, M, shards, ...].
        return (
            orders_KD.unflatten(1, (self.shards, self.num_minibatches, -1))
            .transpose(1, 2)
            .flatten(1)
        )

    def state_dict(self) -> dict[str, int]:
        """Return the integers from which the orders continue exactly (reads the epoch counter on the host)."""
        if self._epoch is None:
            epoch = self._first_epoch
        else:
            epoch = int(self._epoch)
        return {"seed": self.seed, "epoch": epoch, "size": self._size, "position": self._position}

    def load_state_dict(self, state_dict: State) -> None:
        """Continue where `state_dict` was taken."""
        self.seed = int(number(state_dict, "seed"))
        self._first_epoch = int(number(state_dict, "epoch"))
        self._size = int(number(state_dict, "size"))
        self._position = int(number(state_dict, "position"))
        self.ran_out = False
        if self._epoch is None:
            device = torch.device("cpu")
        else:
            device = self._epoch.device
        if self._epoch is not None:
            self._epoch.fill_(self._first_epoch)
        # In the middle of an epoch the rest of its order is needed again.
        if self._position > 0:
            # The counter is one ahead of the epoch whose order is in use.
            previous = torch.full((1,), self._first_epoch - 1, dtype=torch.int64, device=device)
            self._order_D = self._orders(previous, self._size)[0]

    def dumps(self, path: str | Path) -> None:
        """Write the state as JSON into the folder `path`."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "epoch_sampler.json", json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Read the state that `dumps` wrote."""
        self.load_state_dict(
            json.loads(read_bytes(Path(path) / "epoch_sampler.json", limit=MOST_STATE_BYTES))
        )

    def _empty(self) -> None:
        self._size = 0
        self._order_D = None
        self.restart()


def stored(storage: Storage) -> int:
    """Return how many elements a storage has, or raise RuntimeError where there is none to sample."""
    size = len(storage)  # type: ignore[arg-type]
    if size == 0:
        raise RuntimeError("the replay buffer is empty: extend it before sampling")
    return size


BURN_IN_KEY = "burn_in"


class SequenceSampler(EpochSampler):
    """Yields sequences of L successive steps of one env, each once per epoch, in a new random order each epoch.

    A rollout of T steps is cut into T / L sequences, so each epoch has every env state exactly once; None is one of T.
    The indices are [S, L], S the sequences of a minibatch, and a buffer returns data of that shape. The state that a
    recurrent network begins a sequence with is the one stored with its first step.

    With a burn-in of k, at most L, the indices are [S, k + L]: the k steps before each sequence come with it, so that a
    network can renew its state from the one stored there (Kapturowski et al., "Recurrent experience replay in
    distributed reinforcement learning", 2019). A rollout's first sequence has none before it: its first step stands
    there k times. The info has ("collector", "mask"), False where TorchRL's losses must look away, and "burn_in", True
    at the steps that renew the state, both [S, k + L, 1].

    Storages have two dims, [T, E], as TorchRL's with `ndim=2` keep rollouts [E, T]; or one, in which the
    `rollout_length` steps of each env follow each other (`DatasetBuffer`, which sets it). A `batch_size` counts env
    states without burn-in.
    """

    def __init__(
        self,
        *,
        sequence_length: int | None = None,
        burn_in: int = 0,
        rollout_length: int | None = None,
        seed: int = 0,
        shuffle: bool = True,
        shards: int = 1,
        num_minibatches: int = 1,
    ) -> None:
        super().__init__(seed=seed, shuffle=shuffle, shards=shards, num_minibatches=num_minibatches)
        self.sequence_length = sequence_length
        self.burn_in = burn_in
        self.rollout_length = rollout_length

    def begin(self, batch_size_ET: torch.Size, *, batch_size: int) -> None:
        """Note T of a rollout that a storage of one dim receives, and check the sizes before anything is sampled."""
        if len(batch_size_ET) != 2:
            raise ValueError(
                f"sequences are cut from a rollout [E, T]; the data has the dims {tuple(batch_size_ET)}"
            )
        self.rollout_length = batch_size_ET[1]
        sequence_length(
            self.rollout_length, self.sequence_length, batch_size=batch_size, burn_in=self.burn_in
        )

    def sample(self, storage: Storage, batch_size: int) -> tuple[Entries, SampleInfo]:
        """Return the indices [S, k + L] of the next minibatch, and the info dict, which is empty without burn-in."""
        size = stored(storage)
        if storage.ndim > 1:
            steps = storage.shape[0]
        else:
            steps = self.rollout_length
        if steps is None:
            raise ValueError(
                "the storage has one dim: pass rollout_length, the steps of each env in it"
            )
        if size % steps:
            raise ValueError(
                f"the storage has {size} env states: no whole number of rollouts of {steps} steps"
            )
        length = sequence_length(
            steps, self.sequence_length, batch_size=batch_size, burn_in=self.burn_in
        )
        device = torch.device(getattr(storage, "device", None) or "cpu")
        sequence_S = self._next_part(size // length, batch_size // length, device)
        # Within a rollout; negative where there is nothing before it.
        offset_T = torch.arange(-self.burn_in, length, device=device)
        step_ST = (sequence_S * length % steps)[:, None] + offset_T
        # Which env a sequence is of, as rollouts lie one after the other.
        rollout_S1 = (sequence_S * length // steps)[:, None]
        # Before the first step there is nothing to read: it stands there instead, and is masked.
        clamped_ST = step_ST.clamp_min(0)
        index: Entries = rollout_S1 * steps + clamped_ST
        if storage.ndim > 1:
            # A storage of two dims is indexed by step and env.
            index = (clamped_ST, rollout_S1.expand_as(clamped_ST))
        if not self.burn_in:
            return index, {}
        before_T = offset_T < 0
        return index, {
            MASK_KEY: (~before_T).expand_as(step_ST).unsqueeze(-1),
            # Only true steps before a sequence renew its state.
            BURN_IN_KEY: (before_T & (step_ST >= 0)).unsqueeze(-1),
        }


def sequence_length(
    rollout_length: int, length: int | None = None, *, batch_size: int, burn_in: int = 0
) -> int:
    """Return L, `length` or T, once it divides rollouts and minibatches and is no shorter than the burn-in."""
    if length is None:
        length = rollout_length
    if rollout_length % length:
        raise ValueError(
            f"sequence_length={length}: rollouts have {rollout_length} steps, which are no whole number of such "
            "sequences; use a divisor of that"
        )
    if batch_size % length:
        raise ValueError(
            f"sequence_length={length}: num_env_states_per_minibatch={batch_size} is no whole number of such sequences "
            f"({batch_size / length:.4g}); use a multiple of {length} there, another number of envs, or a divisor of "
            f"{batch_size} and {rollout_length} here"
        )
    if burn_in > length:
        raise ValueError(
            f"burn_in={burn_in} is longer than sequence_length={length}: use at most {length}"
        )
    return length
