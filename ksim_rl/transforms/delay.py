"""Observations and actions arrive some env steps late by the transforms of this module."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from ksim_rl.checked import Checked, Share, WholeNumber
from ksim_rl.device import random
from ksim_rl.transforms import ring
from ksim_rl.transforms.checked_keys import Keys
from ksim_rl.transforms.history import RingTransform
from ksim_rl.transforms.row_transform import (
    FollowsLevel,
    KeyedTransform,
    RowTransform,
    checked_action,
)


@dataclass(frozen=True, kw_only=True)
class DelayCfg(Checked):
    """A lag in env steps, drawn uniformly from {min_lag, ..., max_lag}, per env when that env resets.

    Without `per_env` all envs share one, which changes when all reset together, not when some do. Within an episode a
    new lag is drawn every `resample_every` env steps (0 keeps it) since the env's reset, or since all envs last reset
    together; with `hold_probability` such a draw leaves the lag as it is. `by_level` draws from
    {min_lag, ..., min_lag + round(level * (max_lag - min_lag))} (see `FollowsLevel`).
    """

    min_lag: WholeNumber = 0
    max_lag: WholeNumber
    per_env: bool = True
    resample_every: WholeNumber = 0
    hold_probability: Share = 0.0
    by_level: bool = False

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.min_lag > self.max_lag:
            raise ValueError(f"min_lag={self.min_lag} exceeds max_lag={self.max_lag}")
        if self.hold_probability and not self.resample_every:
            raise ValueError(
                f"hold_probability={self.hold_probability} without resample_every: there is no draw to hold"
            )

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the newest value and those before it."""
        return {("max_lag",): num_envs * (self.max_lag + 1)}


class LaggedTransform(FollowsLevel, KeyedTransform, RingTransform):
    """Holds the last `max_lag + 1` values per key in ring buffers, and a lag per env."""

    purposes = ("step/lag", "step/hold", "reset/lag")

    lag_E: Tensor
    shared_count: Tensor
    shared_age: Tensor

    def __init__(
        self, delay: DelayCfg, seed: int | None, stream: str | None, **keys: Keys | None
    ) -> None:
        super().__init__(**keys, seed=seed, stream=stream)  # pyright: ignore[reportArgumentType]
        self._register_rows("lag_E")
        self._register_rings()
        self.delay = delay
        # The newest value and max_lag older ones.
        self.num_slots = delay.max_lag + 1
        # Unlike the count of steps that keys the draws, no seed turns the ages back: they show where the rings stand.
        for name in ("shared_count", "shared_age"):
            self.register_buffer(name, torch.zeros((), dtype=torch.int64))
        self._register_level(is_used=delay.by_level)

    def seed_(self, seed: int) -> Self:
        """Set the seed and start the counters of draws again, in place."""
        self.shared_count.zero_()
        return super().seed_(seed)

    def _size_rows(self, specs: Composite) -> None:
        super()._size_rows(specs)
        self._size_buffer("lag_E", torch.int64)
        # One lag only needs no draws.
        if self._is_fixed:
            self.lag_E.fill_(self.delay.min_lag)

    @property
    def _is_fixed(self) -> bool:
        """Whether there is one lag only, and nothing to draw."""
        return self.delay.min_lag == self.delay.max_lag

    def _advance(self) -> None:
        """Draw new lags for the env step to come, where they are due."""
        delay = self.delay
        # Lags change within an episode only where a period is set.
        if not delay.resample_every or self._is_fixed:
            return
        self.step_count.add_(1)
        # A shared lag is drawn once: a single row broadcasts over all.
        if delay.per_env:
            age = self.age_E + 1
        else:
            age = self.shared_age.add_(1)
        due = age % delay.resample_every == 0
        # A draw that is due may be held, which makes the times of changes irregular.
        if delay.hold_probability:
            chance = random.uniform(self._step_keys("step/hold", shared=not delay.per_env), 1)[:, 0]
            due = due & (chance >= delay.hold_probability)
        # Drawn for all rows and taken where due: the size of a draw does not depend on the data.
        drawn_E = self._draw(self._step_keys("step/lag", shared=not delay.per_env))
        self.lag_E.copy_(torch.where(due, drawn_E, self.lag_E))

    def _rows_that_reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> Tensor:
        """Return which rows reset, bool [E], and draw their lags where the rings do not."""
        # The ring draws and counts these resets itself, in the launch that begins the rows.
        if self._draws_in_ring:
            return RowTransform._rows_that_reset(self, tensordict, tensordict_reset)
        mask_E = super()._rows_that_reset(tensordict, tensordict_reset)
        if self._is_fixed:
            return mask_E
        if self.delay.per_env:
            lag_E = self._draw(self._reset_keys("reset/lag"))
            self.lag_E.copy_(torch.where(mask_E, lag_E, self.lag_E))
            return mask_E
        # A flag on the device: whether all reset is not read on the host.
        together = mask_E.all()
        self.shared_count.add_(together)
        self.shared_age.mul_(~together)
        stream = self._stream_ids["reset/lag"]
        keys = random.row_keys(self.seed_value, stream, self.shared_count, 1, shared=True)
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
        # At level 0 the lag is the smallest, at 1 all lags may come.
        reach = (self.level * (delay.max_lag - delay.min_lag)).round().long()
        return random.integers(keys, 1, delay.min_lag, delay.min_lag + reach)[:, 0]

    def _draws(self, index: int) -> tuple[Any, ...]:
        if index > 0 or not self._draws_in_ring:
            return ring.NO_DRAWS
        state = (
            self._buffers["seed_value"],
            self._buffers["reset_count_E"],
            self._stream_ids["reset/lag"],
        )
        return *state, self.delay.min_lag, self.delay.max_lag


class ObservationDelay(LaggedTransform):
    """Observations as they were some env steps ago; an env that just reset sees its reset observation until then.

    All keys of one transform share the lag. A larger lag than before shows older readings again, a smaller one skips
    some. With `by_level` the range of the lag follows `follow_level_`. Delays in physics substeps are given by
    `ksim_rl.scene.actuators.DelayedActuator`.

    Example:
        >>> delay = ObservationDelay(["imu"], delay=DelayCfg(min_lag=1, max_lag=3, resample_every=50))
    """

    def __init__(
        self,
        in_keys: Keys,
        out_keys: Keys | None = None,
        *,
        delay: DelayCfg,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        super().__init__(delay, seed, stream, in_keys=in_keys, out_keys=out_keys)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._size_rings(observation_spec, self._replace_leaves(observation_spec))
        return observation_spec


class ActionDelay(LaggedTransform):
    """The env receives the action of some env steps ago; the tensordict keeps the one that the policy chose.

    Until the first action of an episode arrives, all its elements are `initial`. With `by_level` the range of the lag
    follows `follow_level_`. A delay of the targets in physics substeps is `ksim_rl.scene.actuators.DelayedActuator`.

    Example:
        >>> delay = ActionDelay(delay=DelayCfg(min_lag=0, max_lag=2))
    """

    def __init__(
        self,
        in_keys_inv: Keys = "action",
        out_keys_inv: Keys | None = None,
        *,
        delay: DelayCfg,
        initial: float = 0.0,
        seed: int | None = None,
        stream: str | None = None,
    ) -> None:
        super().__init__(delay, seed, stream, in_keys_inv=in_keys_inv, out_keys_inv=out_keys_inv)
        self.initial = initial

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        self._size_rings(
            action_spec, self._replace_leaves(action_spec, is_inverse=True), joins=False
        )
        return action_spec

    def _begin(self, tensordict_reset: TensorDictBase, mask_E: Tensor) -> TensorDictBase:
        for index in range(len(self.in_keys_inv)):
            ring_EM: Tensor = getattr(self, f"ring_{index}")
            # The ring begins full of the initial action, which the env gets until the first one arrives.
            self._through(index, torch.full_like(ring_EM[:, 0], self.initial), mask_E)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        rings = [self._sized()[f"ring_{index}"] for index in range(len(self.in_keys_inv))]
        # Refused before the lags move.
        actions = [
            checked_action(tensordict, key, ring_EM.shape[2:], ring_EM.dtype)
            for key, ring_EM in zip(self.out_keys_inv, rings, strict=True)
        ]
        self._advance()
        for index, (key, action) in enumerate(zip(self.in_keys_inv, actions, strict=True)):
            tensordict.set(key, self._through(index, action, None).view(action.shape))
        return tensordict
