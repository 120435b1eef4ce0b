"""Lags and ring buffers, shared by observation and action delay."""

import torch
from torch import Tensor

from ksim_rl import random
from ksim_rl.envs.transforms.delay_cfg import DelayCfg
from ksim_rl.envs.transforms.keyed_transform import KeyedTransform
from ksim_rl.envs.transforms.row_transform import Keys
from ksim_rl.envs.transforms.specs import Device


class LaggedTransform(KeyedTransform):
    """Holds the last `max_lag + 1` values per key in ring buffers, and a lag per env.

    Args:
        delay: how lags are drawn.
        num_signals: number of ring buffers.
        **others: see `KeyedTransform`.
    """

    purposes = ("step/lag", "step/hold", "reset/lag")

    lag_E: Tensor
    age_E: Tensor
    slot: Tensor
    shared_count: Tensor
    shared_age: Tensor

    def __init__(
        self, delay: DelayCfg, num_signals: int, *, seed: int = 0, stream: str | None = None, **keys: Keys
    ) -> None:
        rings = [f"ring_{index}" for index in range(num_signals)]
        super().__init__(**keys, row_buffers=["lag_E", "age_E", *rings], seed=seed, stream=stream)
        self.delay = delay
        self.num_slots = delay.max_lag + 1
        for name in ("slot", "shared_count", "shared_age"):
            self.register_buffer(name, torch.zeros((), dtype=torch.int64))

    def seed_(self, seed: int) -> "LaggedTransform":
        """Set the seed and start the counters of draws anew, in place."""
        self.shared_count.zero_()
        return super().seed_(seed)

    def _size_lags(
        self, num_rows: int, shapes: list[torch.Size], dtypes: list[torch.dtype], device: Device
    ) -> None:
        """Make one ring buffer [K, E, ...] per signal, K = max_lag + 1."""
        self._size_rows(num_rows, device)
        self._size_buffer("lag_E", (num_rows,), torch.int64, device)
        self._size_buffer("age_E", (num_rows,), torch.int64, device)
        for index, (shape, dtype) in enumerate(zip(shapes, dtypes, strict=True)):
            self._size_buffer(f"ring_{index}", (self.num_slots, num_rows, *shape), dtype, device)

    @property
    def _sized(self) -> bool:
        return self.num_rows > 0

    def _advance(self) -> None:
        """Go on by one env step: the next slot, older episodes, and new lags where they are due."""
        self.step_count.add_(1)
        self.slot.add_(1).remainder_(self.num_slots)
        self.age_E.add_(1)
        delay = self.delay
        if not delay.per_env:
            self.shared_age.add_(1)
        if not delay.resample_every:
            return
        # A shared lag is drawn once: a single row broadcasts over all.
        num_rows, age = (self.num_rows, self.age_E) if delay.per_env else (1, self.shared_age)
        due = age % delay.resample_every == 0
        if delay.hold_probability:
            chance = random.uniform(self._step_keys("step/hold", num_rows), 1)[:, 0]
            due = due & (chance >= delay.hold_probability)
        lag = random.integers(self._step_keys("step/lag", num_rows), 1, delay.min_lag, delay.max_lag)[:, 0]
        self.lag_E.copy_(torch.where(due, lag, self.lag_E))

    def _restart(self, mask_E: Tensor) -> None:
        """Begin the episodes of the masked rows, with new lags."""
        delay = self.delay
        self.age_E.masked_fill_(mask_E, 0)
        if delay.per_env:
            lag_E = random.integers(self._reset_keys("reset/lag"), 1, delay.min_lag, delay.max_lag)[:, 0]
            self.lag_E.copy_(torch.where(mask_E, lag_E, self.lag_E))
            return
        together = mask_E.all()
        self.shared_count.add_(together)
        self.shared_age.masked_fill_(together, 0)
        keys = random.row_keys(self.seed_value, self._stream_ids["reset/lag"], self.shared_count, 1)
        lag_1 = random.integers(keys, 1, delay.min_lag, delay.max_lag)[:, 0]
        self.lag_E.copy_(torch.where(together, lag_1, self.lag_E))

    def _push(self, index: int, value: Tensor) -> None:
        """Write a value [E, ...] to the current slot."""
        ring_KE: Tensor = getattr(self, f"ring_{index}")
        ring_KE.index_copy_(0, self.slot.reshape(1), value.unsqueeze(0))

    def _push_rows(self, index: int, value: Tensor, mask_E: Tensor) -> None:
        """Write the masked rows of a value to the current slot."""
        ring_KE: Tensor = getattr(self, f"ring_{index}")
        present = ring_KE.index_select(0, self.slot.reshape(1))[0]
        self._push(index, torch.where(_like(mask_E, value), value, present))

    def _read(self, index: int, lag_E: Tensor) -> Tensor:
        """Return the value of `lag_E` steps ago, [E, ...]."""
        ring_KE: Tensor = getattr(self, f"ring_{index}")
        slot_E = (self.slot - lag_E) % self.num_slots
        where = _like(slot_E, ring_KE[0]).expand(ring_KE.shape[1:]).unsqueeze(0)
        return ring_KE.gather(0, where)[0]


def _like(per_row_E: Tensor, value: Tensor) -> Tensor:
    """Give a tensor [E] the ones that broadcast it over a value [E, ...]."""
    return per_row_E.reshape(-1, *[1] * (value.ndim - 1))
