"""This module is what an env and its managers drive terms with; terms themselves see the driver's view only."""

from collections.abc import Mapping
from typing import Any

from ksim_rl.envs.non_finite import NonFiniteTerms
from ksim_rl.envs.view import EnvView, Readings
from ksim_rl.physics import World
from ksim_rl.scene.sensors import Sensor
from ksim_rl.scene.state.simulation import Simulation


class EnvDriver(Simulation):
    """A `Simulation` with `readings`, what managers and sensors write, and `view`, what terms read.

    The `parts` are the other arguments of the view; see `WorldView`.
    """

    def __init__(self, world: World, *, step_dt: float, max_episode_length: int = 0, **parts: Any) -> None:
        super().__init__(world, step_dt=step_dt, max_episode_length=max_episode_length)
        self.readings = Readings(self)
        self.non_finite = NonFiniteTerms(self.num_envs, self.step_count)
        self.view = EnvView(self, self.readings, **parts)

    def add_sensors(self, sensors: Mapping[str, Sensor]) -> None:
        """Let sensors read the worlds from now on."""
        for name, sensor in sensors.items():
            tracker = self.readings.sensors[name] = sensor.track(name, self.view)
            if tracker.every_substep:
                self.after_substep.append(tracker.update_substep)
                only = tracker.contacts_only and self.substep_sensors != "every"
                self.substep_sensors = "contacts" if only else "every"

    def freeze(self) -> None:
        """End construction: no new buffers, and all that lives on is known to `detached`."""
        super().freeze()
        self.non_finite.start()
        self._lasting.add(self.view.default_qpos_L.untyped_storage().data_ptr())
