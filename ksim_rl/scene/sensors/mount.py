"""This module mounts a sensor at a site of the model, or at a place on a body."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass

import mujoco

from ksim_rl.checks import near
from ksim_rl.scene.sensors.sensor import Sensor


@dataclass(frozen=True, kw_only=True)
class MountedSensor(Sensor, ABC):
    """A sensor at a site of the model, or at a place on a body, whose axes it then has.

    Attributes:
        site: a site of the model, or None.
        body: a body of the model, or None; exactly one of the two is given.
        pos: with `body`, where on it, in its frame, m.
    """

    site: str | None = None
    body: str | None = None
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.site is None) == (self.body is None):
            raise ValueError(f"site={self.site!r}, body={self.body!r}: give exactly one of them")
        if self.site is not None and any(self.pos):
            raise ValueError(
                f"pos={self.pos!r} with site={self.site!r}: a site has its own place; give a body"
            )

    def mounting_site(self, name: str) -> str:
        """Return the name of the site at which the sensor `name` sits."""
        return self.site or f"{name}_mount"

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the site `<name>_mount`, if the sensor is on a body.

        Raises:
            ValueError: if the model has no such site or body.
        """
        kind, wanted, elements = (
            ("site", self.site, spec.sites) if self.body is None else ("body", self.body, spec.bodies)
        )
        present = [element.name for element in elements]
        if wanted not in present:
            raise ValueError(
                f"scene.sensors.{name}: no {kind} {wanted!r}: {near(str(wanted), filter(None, present))}"
            )
        if self.body is not None:
            spec.body(self.body).add_site(name=self.mounting_site(name), pos=list(self.pos))
