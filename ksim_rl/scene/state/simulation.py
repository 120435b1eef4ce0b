"""This module drives the worlds of an env: it knows when the state changes, whose turn it is, and what is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import torch
from jaxtyping import Int64, Shaped
from torch import Tensor

from ksim_rl.device import random
from ksim_rl.physics import World
from ksim_rl.scene.state.buffers import Buffers, SharedValues
from ksim_rl.scene.state.guarded_state import GuardedState


class Simulation(GuardedState):
    """The worlds with their clocks, buffers and draws, for whoever drives them; terms read a `WorldView` of it.

    A moment has two phases: state is written (`changed`), then the world refreshes what derives from it (`refreshed`).
    A term runs inside `scope`, which names its buffers and its draws.

    Attributes:
        physics_dt, step_dt: s, of a substep and of an env step.
        max_episode_length: env steps; 0 for no limit.
        buffers, shared_values: what is kept from step to step, with and without a row per env.
        seed, step_count: int64 []; of all draws, and how many env steps have begun.
        reset_count_E, episode_step_E: int64 [E]; how often each env was reset, and env steps since then.
        time_out_offset_E: int64 [E]; env steps by which a staggered episode times out earlier.
        before_substep, after_substep: called around each physics substep (see `World.step`); they read the world, whose
            state is on its way.
        substep_sensors: at which substeps the world computes its sensors.
    """

    def __init__(self, world: World, *, step_dt: float, max_episode_length: int = 0) -> None:
        super().__init__(world)
        self.num_envs, self.device = world.num_envs, world.device
        self.physics_dt, self.step_dt = float(world.mj_model.opt.timestep), step_dt
        self.max_episode_length = max_episode_length
        self.buffers = Buffers(self.num_envs, self.device)
        self.shared_values = SharedValues(self.device)
        self.seed = torch.zeros((), dtype=torch.int64, device=self.device)
        self.step_count = torch.zeros_like(self.seed)
        self.reset_count_E = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self.episode_step_E = torch.zeros_like(self.reset_count_E)
        self.time_out_offset_E = self.buffers.get("time_out_offset_E", dtype=torch.int64)
        self.before_substep: list[Callable[[], None]] = []
        self.after_substep: list[Callable[[], None]] = []
        self.substep_sensors: Literal["last", "every"] = "last"
        self.startup_counter = torch.zeros_like(self.seed)
        self._counter = self.startup_counter
        self._scope, self._draw_scope, self._draws = "", "", 0
        self._lasting: set[int] = set()

    @contextmanager
    def scope(
        self, name: str, counter: Int64[Tensor, "*envs"] | None = None, *, draws: str = ""
    ) -> Iterator[None]:
        """Run a term under a name, which separates its buffers and its random draws from all others'.

        `counter` keys the draws (the step count unless given), and `draws` tells apart the moments of one term whose
        counters may coincide.

        Raises:
            ValueError: what the term raises, with its name before it.
        """
        self._scope, self._draw_scope, self._draws = name, f"{name}@{draws}", 0
        self.reader = name
        self._counter = self.step_count if counter is None else counter
        try:
            yield
        except ValueError as error:
            # A term does not know its own place in the config.
            raise ValueError(f"{name.replace('/', '.')}: {error}") from error
        finally:
            self._scope = self.reader = ""

    def scoped(self, name: str) -> str:
        """Return the full name of a buffer of the term that runs."""
        return f"{self._scope}.{name}"

    def next_keys(self) -> random.RowKeys:
        """Return the keys of the next draw of the term that runs."""
        stream = random.stream_id(f"{self._draw_scope}#{self._draws}")
        self._draws += 1
        return random.row_keys(self.seed, stream, self._counter, self.num_envs)

    def freeze(self) -> None:
        """End construction: no new buffers, and all that lives on is known to `detached`."""
        self.is_frozen = True
        self.buffers.freeze()
        self.shared_values.freeze()
        lasting = [
            *self.buffers.by_name().values(),
            *self.world.views().values(),
            self.episode_step_E,
        ]
        lasting += [*self.shared_values.by_name().values(), *self.world.per_world_fields().values()]
        self._lasting = {tensor.untyped_storage().data_ptr() for tensor in lasting}

    def detached(self, value: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
        """Return `value`, copied if it shares memory with something that later steps overwrite."""
        return value.clone() if value.untyped_storage().data_ptr() in self._lasting else value
