"""This module has the base of all sensors: a config that edits the model, and a tracker that reads it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import mujoco

from ksim_rl.checked import Checked, Within
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.state.world_view import WorldView

GeomGroup = Annotated[int, Within(low=0, high=mujoco.mjNGROUP - 1)]
"""One of MuJoCo's geom groups."""


class SensorTracker:
    """Reads one sensor. What it reads on demand belongs in `view.cache`, so that it is read once per state.

    Attributes:
        every_substep: whether `update_substep` runs after each physics substep; the worlds then compute their sensors
            at each.
    """

    every_substep: bool = False

    def update(self) -> None:
        """Advance by one env step; it runs in each step, after the refresh (nothing by default)."""

    def update_substep(self) -> None:
        """Read what the last physics substep left (nothing by default); quantities of the view are not current."""

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the reading of one env (nothing by default)."""


@dataclass(frozen=True, kw_only=True)
class Sensor(Checked, ABC):
    """A sensor of `scene.sensors`, where its key is its name."""

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add what the sensor needs to the scene's spec.

        Raises:
            ValueError: if the model lacks what the sensor names.
        """

    @abstractmethod
    def track(self, name: str, view: WorldView) -> SensorTracker:
        """Return the reader of this sensor in the worlds of `view`."""


def sensor_columns(mj_model: mujoco.MjModel, name: str) -> range:
    """Return where the reading of an MJCF sensor stands in `sensordata_EL`."""
    found = mj_model.sensor(name)
    return range(int(found.adr[0]), int(found.adr[0] + found.dim[0]))
