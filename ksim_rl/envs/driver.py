"""Drives terms for an env and its managers; terms themselves see only the driver's view."""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from jaxtyping import Bool
from torch import Tensor

from ksim_rl.envs.non_finite import NonFiniteTerms
from ksim_rl.envs.term_checks.term_guard import TermGuard
from ksim_rl.envs.view import EnvView, Readings
from ksim_rl.physics import World
from ksim_rl.scene.sensors import Sensor, SensorTracker
from ksim_rl.scene.state.buffers import Kept
from ksim_rl.scene.state.simulation import Simulation


class EnvDriver(Simulation):
    """A `Simulation` with `readings`, which managers and sensors write, and `view`, which terms read.

    The `parts` are the other arguments of the view; see `WorldView`.
    """

    def __init__(
        self, world: World, *, step_dt: float, max_episode_length: int = 0, **parts: Any
    ) -> None:
        super().__init__(world, step_dt=step_dt, max_episode_length=max_episode_length)
        # Before the view, which shows them to terms.
        self.readings = Readings(self)
        self.non_finite = NonFiniteTerms(self.num_envs, self.step_count)
        self.view = EnvView(self, self.readings, **parts)
        self.guard = TermGuard(self, self.readings, self.view)

    def seed_(self, seed: int) -> None:
        """Seed all draws, and start their counters again."""
        self.seed.fill_(seed)
        self.step_count.zero_()
        self.reset_count_E.zero_()

    def stagger_episodes(self) -> None:
        """Let the running episodes time out at random steps, where episodes time out."""
        if self.max_episode_length:
            with self.scope("stagger_episodes", self.reset_count_E):
                share_E = self.view.uniform(1)[:, 0]
            self.time_out_offset_E.copy_((share_E * self.max_episode_length).long())

    def add_sensors(self, sensors: Mapping[str, Sensor]) -> None:
        """Let sensors read the worlds from now on."""
        for name, sensor in sensors.items():
            tracker = self.readings.sensors[name] = sensor.track(name, self.view)
            if tracker.every_substep:
                # Such a sensor reads after each substep, where all sensors or only contacts must be computed.
                self.after_substep.append(partial(self._update_in_substep, name, tracker))
                # One sensor that needs more than contacts decides for all.
                only = tracker.contacts_only and self.substep_sensors != "every"
                if only:
                    self.substep_sensors = "contacts"
                else:
                    self.substep_sensors = "every"

    def update_sensors(self) -> None:
        """Let each sensor read the env step that has just been made."""
        for name, tracker in self.readings.sensors.items():
            with self.scope(f"sensors/{name}", part=tracker):
                tracker.update()

    def _update_in_substep(self, name: str, tracker: SensorTracker) -> None:
        with self.scope(f"sensors/{name}", part=tracker):
            tracker.update_substep()

    def freeze(self) -> None:
        """End construction: no new buffers."""
        super().freeze()
        # Values during construction are of no state that anybody sees.
        self.non_finite.start()

    def watch(
        self, part: object, mask_E: Bool[Tensor, " E"] | None
    ) -> AbstractContextManager[Mapping[str, Kept]]:
        """Watch the writes of a part, and refuse those that it must not make: see `TermGuard`."""
        return self.guard.watch(self.reader, part, mask_E)
