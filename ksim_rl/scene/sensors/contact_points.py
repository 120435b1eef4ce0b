"""Senses contacts one by one: where each is, how deep, in which direction, and with which force and torque."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product as pairs_of
from typing import TYPE_CHECKING, Literal, NamedTuple

import mujoco
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Count
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.sensors.contact import ELEMENT_TABLES, ContactElements, columns_of, from_contact
from ksim_rl.scene.sensors.sensor import SensorTracker
from ksim_rl.scene.state.world_view import WorldView

_WIDTHS = {
    "found": 1,
    "force": 3,
    "torque": 3,
    "distance": 1,
    "position": 3,
    "normal": 3,
    "tangent": 3,
}
"""All that MuJoCo's contact sensor gives, in the order of its bits and of its numbers."""
_ALL = (1 << len(_WIDTHS)) - 1
_ORDERS = {"deepest": 1, "strongest": 2}
_KEPT = ("force", "torque", "distance")


@dataclass(frozen=True, kw_only=True)
class ContactPoints(ContactElements):
    """The separate contacts of elements with each of several partners: up to `num_slots` of each pair, N in all.

    Elements are given as in `ContactSensor`. Their contacts stand one after the other: of the first element with
    the first partner of `against`, with the second, and so on, then of the next element. It has no clocks.

    Attributes:
        against: the names of the partners, each of the kind `against_kind`; none of them stands for anything.
        order: which contacts of a pair come first, and so remain where there are more than slots.
        history: the number of physics substeps whose forces, torques and distances are kept; with more than 1 the
            sensor is read at each substep.
    """

    against: tuple[str, ...] = ("terrain",)
    num_slots: Count = 1
    order: Literal["deepest", "strongest"] = "strongest"
    history: Count = 1

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the forces that are kept, of one pair."""
        return {("num_slots", "history"): 3 * num_envs * self.num_slots * self.history}

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add one MJCF contact sensor `<name>_<element>_<partner>` per pair."""
        intprm = (_ALL, _ORDERS[self.order], self.num_slots)
        for element, partner in pairs_of(self.elements_of(spec, name), self.against or (None,)):
            called = _pair_name(name, element, partner)
            self.add_contacts(spec, name, of=element, against=partner, intprm=intprm, called=called)

    def track(self, name: str, view: WorldView) -> "ContactPointsTracker":
        return ContactPointsTracker(name, self, view)


def _pair_name(name: str, element: str, partner: str | None) -> str:
    return f"{name}_{element}_{partner or 'anything'}"


class ContactPointsState(NamedTuple):
    """N contacts, float32, after the last substep (acceleration stage); 0 in empty slots and in rows just reset."""

    found_EN: Float[Tensor, "E N"]
    """1 where the slot holds a contact, else 0, [E, N]."""
    force_EN3: Float[Tensor, "E N 3"]
    """Force of the element on its partner, N, world frame, [E, N, 3]."""
    torque_EN3: Float[Tensor, "E N 3"]
    """Torque of the element on its partner about that point, N m, world frame, [E, N, 3]; 0 for `condim` 1 and 3."""
    distance_EN: Float[Tensor, "E N"]
    """Distance of the surfaces, m, [E, N]; negative where they overlap."""
    position_EN3: Float[Tensor, "E N 3"]
    """Point of contact, m, world frame, [E, N, 3]."""
    normal_EN3: Float[Tensor, "E N 3"]
    """Unit normal from the element to its partner, world frame, [E, N, 3]."""
    force_history_ESN3: Float[Tensor, "E S N 3"]
    """`force_EN3` of the last `history` substeps, oldest first, N, world frame, [E, S, N, 3]."""
    torque_history_ESN3: Float[Tensor, "E S N 3"]
    """`torque_EN3` of the last `history` substeps, oldest first, N m, world frame, [E, S, N, 3]."""
    distance_history_ESN: Float[Tensor, "E S N"]
    """`distance_EN` of the last `history` substeps, oldest first, m, [E, S, N]."""

    # A named tuple takes no second base.
    if not TYPE_CHECKING:
        __getattr__ = NearNames.__getattr__


class ContactPointsTracker(SensorTracker):
    """Reads the contacts of one sensor after the last substep, or after each, to keep a history."""

    contacts_only = True

    def __init__(self, name: str, sensor: ContactPoints, view: WorldView) -> None:
        self._key = f"contact_points/{name}"
        self._view = view
        elements = sensor.elements(view.resolver.names(ELEMENT_TABLES[sensor.kind]))
        names = [_pair_name(name, *pair) for pair in pairs_of(elements, sensor.against or (None,))]
        self._columns = columns_of(view, names)
        self._num_contacts = len(names) * sensor.num_slots
        self.every_substep = sensor.history > 1
        # By substep, the newest last; zeroed at resets, as no substep of the episode was before.
        self._histories: dict[str, Tensor] = {}
        if self.every_substep:
            for part in _KEPT:
                shape = (sensor.history, self._num_contacts, _WIDTHS[part])
                self._histories[part] = view.buffers.get(f"{self._key}.{part}_history", *shape)

    def update_substep(self) -> None:
        """Add the substep to the history, whose oldest one falls out."""
        parts = self._parts()
        for part, history_ESNL in self._histories.items():
            # A world that fails must not leave its numbers to the terms that run after it was cleared.
            newest_E1NL = torch.nan_to_num(parts[part], nan=0.0, posinf=0.0, neginf=0.0)[:, None]
            history_ESNL.copy_(torch.cat((history_ESNL[:, 1:], newest_E1NL), dim=1))

    @property
    def state(self) -> ContactPointsState:
        """The contacts after the last substep."""
        cache = self._view.cache
        if self._key not in cache:
            parts = self._parts()
            # Without a history the last substep is all there is.
            kept = {part: self._histories.get(part, parts[part][:, None]) for part in _KEPT}
            cache[self._key] = ContactPointsState(
                found_EN=parts["found"][..., 0],
                force_EN3=parts["force"],
                torque_EN3=parts["torque"],
                distance_EN=parts["distance"][..., 0],
                position_EN3=parts["position"],
                normal_EN3=parts["normal"],
                force_history_ESN3=kept["force"],
                torque_history_ESN3=kept["torque"],
                distance_history_ESN=kept["distance"][..., 0],
            )
        return cache[self._key]

    def _parts(self) -> dict[str, Tensor]:
        """Return the readings by name, [E, N, width], with forces and torques in the world's axes."""
        readings_ENL = self._view.world.sensordata_EL[:, self._columns].unflatten(
            1, (self._num_contacts, -1)
        )
        parts = dict(zip(_WIDTHS, readings_ENL.split(tuple(_WIDTHS.values()), dim=-1), strict=True))
        # MuJoCo counts all contacts of the pair in each slot that holds one.
        parts["found"] = (parts["found"] > 0).to(torch.float32)
        for part in ("force", "torque"):
            parts[part] = from_contact(
                parts[part], normal=parts["normal"], tangent=parts["tangent"]
            )
        return parts
