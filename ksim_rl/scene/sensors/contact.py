"""This module senses contact: what geoms, bodies or whole limbs touch, how hard, and since when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco

from ksim_rl.checks import near
from ksim_rl.scene.names import match_names
from ksim_rl.scene.sensors.contact_tracker import ContactTracker
from ksim_rl.scene.sensors.sensor import Sensor
from ksim_rl.scene.state.world_view import WorldView

_OBJECTS = {
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    # MuJoCo's contact sensor reads this type as the body with all its descendants.
    "subtree": mujoco.mjtObj.mjOBJ_XBODY,
}
_TABLES = {"geom": "geom", "body": "body", "subtree": "body"}
# Bits of MuJoCo's contact sensor (mjtConDataField) and its reductions.
_FOUND, _FORCE, _POSITION, _NORMAL, _TANGENT = 1 << 0, 1 << 1, 1 << 4, 1 << 5, 1 << 6
_STRONGEST, _NET = 2, 3


@dataclass(frozen=True, kw_only=True)
class ContactSensor(Sensor):
    """Contact of N elements of the scene with another element, or with anything.

    Exactly one of `geoms`, `bodies` and `subtrees` says what the elements are: names, or regular expressions that must
    match in full. Each pattern's matches come in the model's order, and give the N dim.

    Attributes:
        geoms: single geoms.
        bodies: bodies with all their geoms.
        subtrees: bodies with all their descendants: a limb, or a whole robot.
        against: the name of what they touch; None for anything, also for parts of their own robot.
        against_kind: what `against` names: a "geom", a "body", or a "subtree".
        reduce: of several contacts, their "net" force, or the force of the "strongest" one. Within one subtree, as in
            self-collisions, each contact's direction is arbitrary, so only "strongest" has a meaning.
        every_substep: read at each physics substep, not only at the last one of an env step: the clocks run in physics
            steps, and `ContactState.force_history_ESN3` holds the force of each substep.
    """

    geoms: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    subtrees: tuple[str, ...] = ()
    against: str | None = "terrain"
    against_kind: Literal["geom", "body", "subtree"] = "body"
    reduce: Literal["net", "strongest"] = "net"
    every_substep: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [field for field in ("geoms", "bodies", "subtrees") if getattr(self, field)]
        if len(given) != 1:
            raise ValueError(
                f"geoms={self.geoms!r}, bodies={self.bodies!r}, subtrees={self.subtrees!r}: give exactly one of them"
            )
        within_one = self.against_kind == "subtree" and self.against in self.subtrees
        if within_one and self.reduce == "net":
            raise ValueError(
                f"reduce='net' with against={self.against!r}, one of the subtrees: forces within one subtree have no "
                "common direction; use reduce='strongest'"
            )

    @property
    def kind(self) -> Literal["geom", "body", "subtree"]:
        """What the elements are."""
        return "geom" if self.geoms else "body" if self.bodies else "subtree"

    def elements(self, present: Sequence[str]) -> list[str]:
        """Return the elements among the `present` ones of their kind, in the order of the N dim.

        Raises:
            ValueError: if a pattern matches nothing.
        """
        patterns = self.geoms or self.bodies or self.subtrees
        return [present[i] for i in match_names(_TABLES[self.kind], patterns, present)]

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add one MJCF contact sensor `<name>_<element>` per element.

        Raises:
            ValueError: if the model has no such element.
        """
        where = f"scene.sensors.{name}"
        present = _names(spec, self.kind)
        try:
            elements = self.elements(present)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
        others = _names(spec, self.against_kind)
        if self.against is not None and self.against not in others:
            raise ValueError(
                f"{where}: no {_TABLES[self.against_kind]} {self.against!r}: {near(self.against, others)}"
            )
        bits = _FOUND | _FORCE | _POSITION
        reduction = _NET
        if self.reduce == "strongest":
            # A single contact's force is in the axes of that contact, which are needed to turn it.
            bits, reduction = bits | _NORMAL | _TANGENT, _STRONGEST
        other = {}
        if self.against is not None:
            other = {"reftype": _OBJECTS[self.against_kind], "refname": self.against}
        for element in elements:
            spec.add_sensor(
                name=f"{name}_{element}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=_OBJECTS[self.kind],
                objname=element,
                intprm=[bits, reduction, 1],
                **other,
            )

    def track(self, name: str, view: WorldView) -> ContactTracker:
        """Return the reader of this sensor in the worlds of `view`."""
        return ContactTracker(
            name,
            view,
            elements=self.elements(view.resolver.names(_TABLES[self.kind])),
            strongest=self.reduce == "strongest",
            every_substep=self.every_substep,
        )


def _names(spec: mujoco.MjSpec, kind: str) -> list[str]:
    return [element.name for element in (spec.geoms if kind == "geom" else spec.bodies)]
