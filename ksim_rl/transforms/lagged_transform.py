"""This module holds what delays of observations and of actions share: how lags are drawn, and the ring buffers."""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from ksim_rl import checks
from ksim_rl.device import random
from ksim_rl.transforms import ring
from ksim_rl.transforms.keyed_transform import KeyedTransform
from ksim_rl.transforms.level import FollowsLevel
from ksim_rl.transforms.row_transform import Keys, RowTransform
from ksim_rl.transforms.specs import Device


@dataclass(frozen=True, kw_only=True)
class DelayCfg:
    """A lag in env steps, drawn uniformly from {min_lag, ..., max_lag}.

    Args:
        min_lag, max_lag: env steps, both included.
        per_env: True draws a lag per env when that env resets. False draws one lag for all envs; it changes when all
            envs reset at once, not when some do.
        resample_every: env steps after which a new lag is drawn within an episode; 0 keeps it. Counted per env since
            its reset, or since all envs last reset together.
        hold_probability: chance that such a draw leaves the lag as it is.
        by_level: whether the transform's level (see `FollowsLevel`) sets the reach: lags are drawn from
            {min_lag, ..., min_lag + round(level * (max_lag - min_lag))}.
    """

    min_lag: int = 0
    max_lag: int
    per_env: bool = True
    resample_every: int = 0
    hold_probability: float = 0.0
    by_level: bool = False

    def __post_init__(self) -> None:
        for field in ("min_lag", "max_lag", "resample_every"):
            checks.check_count(field, getattr(self, field), low=0)
        if self.min_lag > self.max_lag:
            raise ValueError(f"min_lag={self.min_lag} exceeds max_lag={self.max_lag}")
        checks.check_in_range("hold_probability", self.hold_probability, low=0.0, high=1.0)
        if self.hold_probability and not self.resample_every:
            raise ValueError(
                f"hold_probability={self.hold_probability} without resample_every: there is no draw to hold"
            )


class LaggedTransform(FollowsLevel, KeyedTransform):
    """Holds the last `max_lag + 1` values per key in ring buffers, and a lag per env.

    Args:
        delay: how lags are drawn.
        num_signals: number of ring buffers.
        **others: see `KeyedTransform`.
    """

    purposes = ("step/lag", "step/hold", "reset/lag")

    lag_E: Tensor
    age_E: Tensor
    shared_count: Tensor
    shared_age: Tensor

    def __init__(
        self, delay: DelayCfg, num_signals: int, *, seed: int = 0, stream: str | None = None, **keys: Keys
    ) -> None:
        rings = [f"ring_{index}" for index in range(num_signals)]
        super().__init__(**keys, row_buffers=["lag_E", "age_E", *rings], seed=seed, stream=stream)
        self.delay = delay
        self.num_slots = delay.max_lag + 1
        self.num_rings = 0
        # Unlike the count of steps that keys the draws, no seed turns the ages back: they show where the rings stand.
        for name in ("shared_count", "shared_age"):
            self.register_buffer(name, torch.zeros((), dtype=torch.int64))
        self._register_level(is_used=delay.by_level)

    def seed_(self, seed: int) -> "LaggedTransform":
        """Set the seed and start the counters of draws anew, in place."""
        self.shared_count.zero_()
        return super().seed_(seed)

    def _size_lags(
        self, num_rows: int, shapes: list[torch.Size], dtypes: list[torch.dtype], device: Device
    ) -> None:
        """Make one ring buffer [E, M, ...] per signal, M = max_lag + 1."""
        self._size_rows(num_rows, device)
        self._size_buffer("lag_E", (num_rows,), torch.int64, device)
        self._size_buffer("age_E", (num_rows,), torch.int64, device)
        if self._is_fixed:
            self.lag_E.fill_(self.delay.min_lag)
        self.num_rings = len(shapes)
        for index, (shape, dtype) in enumerate(zip(shapes, dtypes, strict=True)):
            self._size_buffer(f"ring_{index}", (num_rows, self.num_slots, *shape), dtype, device)

    @property
    def _is_fixed(self) -> bool:
        """Whether there is one lag only, and nothing to draw."""
        return self.delay.min_lag == self.delay.max_lag

    @property
    def _sized(self) -> bool:
        return self.num_rows > 0

    def _advance(self) -> None:
        """Draw new lags for the env step to come, where they are due."""
        delay = self.delay
        if not delay.resample_every or self._is_fixed:
            return
        self.step_count.add_(1)
        # A shared lag is drawn once: a single row broadcasts over all.
        num_rows, age = (self.num_rows, self.age_E + 1) if delay.per_env else (1, self.shared_age.add_(1))
        due = age % delay.resample_every == 0
        if delay.hold_probability:
            chance = random.uniform(self._step_keys("step/hold", num_rows), 1)[:, 0]
            due = due & (chance >= delay.hold_probability)
        self.lag_E.copy_(torch.where(due, self._draw(self._step_keys("step/lag", num_rows)), self.lag_E))

    def _rows_that_reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> Tensor:
        """Return which rows reset, bool [E], with what the rings do not do as these rows begin."""
        if self._draws_in_ring:
            return RowTransform._reset_rows(self, tensordict, tensordict_reset)
        mask_E = self._reset_rows(tensordict, tensordict_reset)
        if self._is_fixed:
            return mask_E
        if self.delay.per_env:
            lag_E = self._draw(self._reset_keys("reset/lag"))
            self.lag_E.copy_(torch.where(mask_E, lag_E, self.lag_E))
            return mask_E
        together = mask_E.all()
        self.shared_count.add_(together)
        self.shared_age.mul_(~together)
        keys = random.row_keys(self.seed_value, self._stream_ids["reset/lag"], self.shared_count, 1)
        self.lag_E.copy_(torch.where(together, self._draw(keys), self.lag_E))
        return mask_E

    @property
    def _draws_in_ring(self) -> bool:
        """Whether the launch that lets rows begin draws their lags too."""
        return self.delay.per_env and not self.delay.by_level and not self._is_fixed

    def _draw(self, keys: random.RowKeys) -> Tensor:
        """Draw lags, int64 [E] or [1]."""
        delay = self.delay
        if not delay.by_level:
            return random.integers(keys, 1, delay.min_lag, delay.max_lag)[:, 0]
        reach = (self.level * (delay.max_lag - delay.min_lag)).round().long()
        return random.integers(keys, 1, delay.min_lag, delay.min_lag + reach)[:, 0]

    def _through(self, index: int, value: Tensor, mask_E: Tensor | None) -> Tensor:
        """Write this step's value [E, ...] and return the one that is due; masked rows begin with it."""
        buffers: dict[str, Any] = self._buffers
        ring_EM, age_E = buffers[f"ring_{index}"], buffers["age_E"]
        value_E = value if value.ndim == ring_EM.ndim - 1 else value.reshape(-1, *ring_EM.shape[2:])
        if mask_E is None:
            counts = index == self.num_rings - 1
            found_EL = ring.push(ring_EM, age_E, value_E, lag_E=buffers["lag_E"], counts=counts)
        else:
            lags = self._lags() if index == 0 and self._draws_in_ring else None
            found_EL = ring.begin(ring_EM, age_E, value_E, mask_E, lags=lags)
        return found_EL if value.ndim == 2 else found_EL.view(value.shape)

    def _lags(self) -> ring.Lags:
        buffers, delay = self._buffers, self.delay
        stream = self._stream_ids["reset/lag"]
        drawn = buffers["lag_E"], buffers["seed_value"], buffers["reset_count_E"]
        return ring.Lags(*drawn, stream, delay.min_lag, delay.max_lag)
