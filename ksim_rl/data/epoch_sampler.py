"""This module samples without replacement, in an order of (seed, epoch) that stays on the device."""

import json
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int64
from torch import Tensor
from torchrl.data.replay_buffers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from ksim_rl.device import random

_STREAM = random.stream_id("data.epoch_sampler")


class EpochSampler(Sampler):
    """Yields every stored env state once per epoch, in a new random order each epoch.

    A drop-in for TorchRL's `SamplerWithoutReplacement` in any replay buffer. The order is the rank of
    counter-based random keys, so it needs no generator, makes no host sync, can be captured in a CUDA graph
    (the epoch counter is a device tensor; capture whole epochs), and resumes from four integers.

    Args:
        seed: two samplers with the same seed give the same orders.
        shuffle: False reads in the order of the storage.
        drop_last: leave out the last, smaller minibatch when the sizes do not divide.
    """

    # Whether the last minibatch was the last of its epoch; iterating over the buffer stops there.
    ran_out: bool = False  # pyright: ignore[reportIncompatibleMethodOverride]

    def __init__(self, *, seed: int = 0, shuffle: bool = True, drop_last: bool = False) -> None:
        self.seed, self.shuffle, self.drop_last = seed, shuffle, drop_last
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

    def extend(self, index: Any) -> None:
        """Start a new epoch, because the data is new."""
        self.restart()

    def restart(self) -> None:
        """Leave the present epoch: the next sample is the first of a new one."""
        self._position, self.ran_out = 0, False

    def sample(self, storage: Storage, batch_size: int) -> tuple[Any, dict]:
        """Return the indices of the next minibatch [B] and an empty info dict.

        Raises:
            ValueError: if `drop_last` leaves nothing, because the minibatch is larger than the storage.
        """
        size = len(storage)  # type: ignore[arg-type]
        if size == 0:
            raise RuntimeError("the replay buffer is empty: extend it before sampling")
        if self.drop_last and batch_size > size:
            raise ValueError(
                f"batch_size={batch_size} exceeds the {size} stored elements and drop_last=True: "
                "nothing could be sampled; use a smaller batch_size or drop_last=False"
            )
        index = self._next_part(size, batch_size, torch.device(getattr(storage, "device", None) or "cpu"))
        if storage.ndim > 1:
            index = torch.unravel_index(index, storage.shape)
        return index, {}

    def epoch_order(self, size: int, *, device: torch.device) -> Int64[Tensor, " D"]:
        """Begin an epoch and return its order of `range(size)`, as `sample` would give it in parts."""
        self.restart()
        return self._next_part(size, size, device)

    def _next_part(self, size: int, batch_size: int, device: torch.device) -> Tensor:
        """Return the next `batch_size` elements of the epoch's order of `range(size)`, on the device."""
        if size != self._size:
            self._size, self._position = size, 0
        if self._position == 0:
            self._order_D = self._next_order(size, device)
        assert self._order_D is not None
        index = self._order_D[self._position : self._position + batch_size]
        self._position += batch_size
        left = size - self._position
        self.ran_out = left <= 0 or (self.drop_last and left < batch_size)
        if self.ran_out:
            self._position = 0
        self._remaining_batches = left // batch_size if self.drop_last else -(-left // batch_size)
        return index

    def _next_order(self, size: int, device: torch.device) -> Tensor:
        if not self.shuffle:
            return torch.arange(size, device=device)
        if self._epoch is None or self._epoch.device != device:
            self._epoch = torch.full((), self._first_epoch, dtype=torch.int64, device=device)
        order_D = permutation(self.seed, self._epoch, size)
        self._epoch.add_(1)
        return order_D

    def state_dict(self) -> dict[str, int]:
        """Return the integers from which the orders continue exactly (reads the epoch counter on the host)."""
        epoch = self._first_epoch if self._epoch is None else int(self._epoch)
        return {"seed": self.seed, "epoch": epoch, "size": self._size, "position": self._position}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        self.seed = int(state_dict["seed"])
        self._first_epoch = int(state_dict["epoch"])
        self._size, self._position = int(state_dict["size"]), int(state_dict["position"])
        self.ran_out = False
        device = torch.device("cpu") if self._epoch is None else self._epoch.device
        if self._epoch is not None:
            self._epoch.fill_(self._first_epoch)
        if self._position > 0:
            previous = torch.full((), self._first_epoch - 1, dtype=torch.int64, device=device)
            unshuffled = torch.arange(self._size, device=device)
            self._order_D = permutation(self.seed, previous, self._size) if self.shuffle else unshuffled

    def dumps(self, path: str | Path) -> None:
        """Write the state as JSON into the folder `path`."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "epoch_sampler.json").write_text(json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Read what `dumps` wrote."""
        self.load_state_dict(json.loads((Path(path) / "epoch_sampler.json").read_text()))

    def _empty(self) -> None:
        self._size = 0
        self._order_D = None
        self.restart()


def permutation(seed: int, epoch: Int64[Tensor, ""], size: int) -> Int64[Tensor, " D"]:
    """Return a random permutation of `range(size)` that depends on `seed` and `epoch` only.

    Args:
        epoch: its device is that of the result.
    """
    seed_tensor = torch.full((), seed, dtype=torch.int64, device=epoch.device)
    keys = random.row_keys(seed_tensor, _STREAM, epoch, size)
    keys_D = random.integers(keys, 1, 0, 2**31 - 1).squeeze(1).to(torch.int32)
    # Of 100 000 keys of 31 bits about two pairs are equal. They keep their order, so it is still a permutation, and the
    # sort takes half the passes that it takes for 64 bits.
    return torch.argsort(keys_D, stable=True)
