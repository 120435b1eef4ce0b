"""The bases of sensors: a config that edits the model, perhaps mounted on a body, and a reader."""

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import mujoco

from ksim_rl.checked import Checked, Within
from ksim_rl.checks import near
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.state.world_view import WorldView

GeomGroup = Annotated[int, Within(low=0, high=mujoco.mjNGROUP - 1)]
"""One of MuJoCo's geom groups."""


class SensorTracker(NearNames):
    """Reads one sensor. Readings on demand belong in `view.cache`, so that it is read once per state.

    With `every_substep`, `update_substep` runs after each physics substep, at which the worlds then compute their
    sensors; contact sensors alone with `contacts_only`, if all such trackers have it, which takes less time.
    """

    every_substep: bool = False
    contacts_only: bool = False

    def update(self) -> None:
        """Advance by one env step; it runs in each step, after the refresh (nothing by default)."""

    def update_substep(self) -> None:
        """Read the results of the last physics substep (nothing by default); quantities of the view are not current."""

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the reading of one env (nothing by default)."""


@dataclass(frozen=True, kw_only=True)
class Sensor(Checked, ABC):
    """A sensor of `scene.sensors`, where its key is its name; `warp_alone` names the part that needs MuJoCo Warp."""

    warp_alone: ClassVar[str] = ""

    @abstractmethod
    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the sensor's elements to the scene's spec; a ValueError if the model lacks an element that it names."""

    @abstractmethod
    def track(self, name: str, view: WorldView) -> SensorTracker:
        """Return the reader of this sensor in the worlds of `view`."""


def check_present(name: str, kind: str, wanted: str | None, elements: Sequence[Any]) -> None:
    """Refuse a sensor `name` that wants an element which is not among these of the spec, by a ValueError."""
    present = [element.name for element in elements]
    if wanted not in present:
        several: list[str] = []
        # A name may be no valid pattern, and is then just unknown.
        with suppress(re.error):
            several = [other for other in present if other and re.fullmatch(str(wanted), other)]
        # A pattern where a name is expected is a likely mistake, and gets its own message.
        if several:
            raise ValueError(
                f"scene.sensors.{name}: {wanted!r} matches {several}, but the sensor takes the name of one {kind} "
                "there: name one of them, or a body or subtree that holds them, or give one sensor each"
            )
        raise ValueError(
            f"scene.sensors.{name}: no {kind} {wanted!r}: {near(str(wanted), filter(None, present))}"
        )


@dataclass(frozen=True, kw_only=True)
class MountedSensor(Sensor, ABC):
    """A sensor at a `site` of the model, or on a `body` at `pos` (m, in its frame, whose axes the sensor then has)."""

    site: str | None = None
    body: str | None = None
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def _check_fields(self) -> None:
        super()._check_fields()
        self._check_mount()

    def _check_mount(self) -> None:
        """Raise ValueError where it is not clear what the sensor sits on."""
        # With both, or none, the place would be unclear.
        if (self.site is None) == (self.body is None):
            raise ValueError(f"site={self.site!r}, body={self.body!r}: give exactly one of them")
        # A position next to a site would be ignored in silence.
        if self.site is not None and any(self.pos):
            raise ValueError(
                f"pos={self.pos!r} with site={self.site!r}: a site has its own place; give a body"
            )

    def mounting_site(self, name: str) -> str:
        """Return the name of the site at which the sensor `name` sits."""
        # A new site is named after the sensor.
        return self.site or f"{name}_mount"

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the site `<name>_mount`, if the sensor is on a body."""
        if self.body is None:
            check_present(name, "site", self.site, spec.sites)
        else:
            check_present(name, "body", self.body, spec.bodies)
            spec.body(self.body).add_site(name=self.mounting_site(name), pos=list(self.pos))
