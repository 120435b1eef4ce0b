"""This module holds the base of transforms that draw: each number is a function of (seed, stream, env row, counter)."""

from collections.abc import Sequence
from typing import ClassVar, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl.device import random
from ksim_rl.transforms.row_transform import Keys, RowTransform
from ksim_rl.transforms.specs import Device


class KeyedTransform(RowTransform):
    """Base of transforms with draws of their own.

    Draws in a step are keyed by `step_count`, which counts env steps; draws at a reset by `reset_count_E`, which counts
    each row's own resets. So a reset of one row never changes another row's numbers, and TorchRL's reset of the rows
    that are done equals a masked reset at every step.

    Args:
        in_keys, out_keys, in_keys_inv, out_keys_inv: as in `torchrl.envs.transforms.Transform`.
        row_buffers: names of the buffers that the env sizes.
        seed: until `seed_` or the env's `set_seed` gives another one.
        stream: name of the stream of draws. Default: class name and keys, so two transforms of one env differ unless
            they are of one class and have the same keys.
    """

    purposes: ClassVar[tuple[str, ...]] = ()
    """What the class draws, each from a stream of its own."""

    seed_value: Tensor
    step_count: Tensor
    reset_count_E: Tensor

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        in_keys_inv: Keys | None = None,
        out_keys_inv: Keys | None = None,
        *,
        row_buffers: Sequence[str] = (),
        seed: int = 0,
        stream: str | None = None,
    ) -> None:
        names = ("reset_count_E", *row_buffers)
        super().__init__(in_keys, out_keys, in_keys_inv, out_keys_inv, row_buffers=names)
        keys = (self.in_keys, self.out_keys, self.in_keys_inv, self.out_keys_inv)
        self.stream = type(self).__name__ + "".join(map(str, keys)) if stream is None else stream
        self._stream_ids = {
            purpose: random.stream_id(f"{self.stream}/{purpose}") for purpose in self.purposes
        }
        self.register_buffer("seed_value", torch.tensor(seed, dtype=torch.int64))
        self.register_buffer("step_count", torch.zeros((), dtype=torch.int64))

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters anew, in place."""
        self.seed_value.fill_(seed)
        self.step_count.zero_()
        if self._buffers["reset_count_E"] is not None:
            self.reset_count_E.zero_()
        return self

    def _size_rows(self, num_rows: int, device: Device) -> None:
        super()._size_rows(num_rows, device)
        self._size_buffer("reset_count_E", (num_rows,), torch.int64, device)

    def _reset_rows(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> Tensor:
        mask_E = super()._reset_rows(tensordict, tensordict_reset)
        self.reset_count_E.add_(mask_E)
        return mask_E

    def _step_keys(self, purpose: str, num_rows: int | None = None) -> random.RowKeys:
        rows = self.num_rows if num_rows is None else num_rows
        return random.row_keys(self.seed_value, self._stream_ids[purpose], self.step_count, rows)

    def _reset_keys(self, purpose: str) -> random.RowKeys:
        return random.row_keys(self.seed_value, self._stream_ids[purpose], self.reset_count_E, self.num_rows)
