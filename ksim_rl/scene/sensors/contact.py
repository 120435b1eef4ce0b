"""Senses the contacts of geoms, bodies or whole limbs: whether they touch, how hard, and since when."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checks import naming
from ksim_rl.physics.sensors.contact_sensors import MATCHED, NET, STRONGEST
from ksim_rl.scene.names import Index, as_index, match_names
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors.sensor import Sensor, SensorTracker, check_present
from ksim_rl.scene.small_matrices import product
from ksim_rl.scene.state.world_view import WorldView

ELEMENT_TABLES = {"geom": "geom", "body": "body", "subtree": "body"}
"""The kinds of element of a model that elements of a sensor are, by how a sensor calls them."""
_RGBA = (1.0, 0.55, 0.1, 1.0)


@dataclass(frozen=True, kw_only=True)
class ContactElements(Sensor):
    """A sensor of the contacts of elements of the scene.

    Exactly one of `geoms`, `bodies` (with all their geoms) and `subtrees` (bodies with all their descendants: a limb,
    or a whole robot) gives the elements: names, or regular expressions that must match in full. Each pattern's
    matches come in the model's order.

    Attributes:
        against_kind: what `against` names: a geom, a body or a subtree.
    """

    geoms: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    subtrees: tuple[str, ...] = ()
    against_kind: Literal["geom", "body", "subtree"] = "body"

    def _check_fields(self) -> None:
        super()._check_fields()
        given = [field for field in ("geoms", "bodies", "subtrees") if getattr(self, field)]
        if len(given) != 1:
            raise ValueError(
                f"geoms={self.geoms!r}, bodies={self.bodies!r}, subtrees={self.subtrees!r}: give exactly one of them"
            )

    @property
    def kind(self) -> Literal["geom", "body", "subtree"]:
        """The kind of the elements."""
        if self.geoms:
            return "geom"
        if self.bodies:
            return "body"
        return "subtree"

    def elements(self, present: Sequence[str]) -> list[str]:
        """Return the elements among the `present` ones of their kind, in the order of the N dim."""
        patterns = self.geoms or self.bodies or self.subtrees
        return [present[i] for i in match_names(ELEMENT_TABLES[self.kind], patterns, present)]

    def add_contacts(
        self,
        spec: mujoco.MjSpec,
        name: str,
        *,
        of: str,
        against: str | None,
        intprm: Sequence[int],
        called: str,
    ) -> None:
        """Add the MJCF contact sensor `called`, of one element against another, or anything, for the sensor `name`."""
        # Without `against` MuJoCo takes any other geom.
        other = {}
        if against is not None:
            table = ELEMENT_TABLES[self.against_kind]
            check_present(name, table, against, {"geom": spec.geoms, "body": spec.bodies}[table])
            other = {"reftype": MATCHED[self.against_kind], "refname": against}
        spec.add_sensor(
            name=called,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=MATCHED[self.kind],
            objname=of,
            intprm=[*intprm],
            **other,
        )

    def elements_of(self, spec: mujoco.MjSpec, name: str) -> list[str]:
        """Return the elements in a spec, for the sensor `name`."""
        parts = {"geom": spec.geoms, "body": spec.bodies}
        with naming(f"scene.sensors.{name}"):
            return self.elements([part.name for part in parts[ELEMENT_TABLES[self.kind]]])


@dataclass(frozen=True, kw_only=True)
class ContactSensor(ContactElements):
    """Contact of N elements of the scene with another element, or with anything; see `ContactPoints` for details.

    Exactly one of `geoms`, `bodies` (with all their geoms) and `subtrees` (bodies with all their descendants: a limb,
    or a whole robot) gives the elements: names, or regular expressions that must match in full. Each pattern's
    matches come in the model's order, and give the N dim.

    Attributes:
        against: the name of the element that they touch; None for anything, also for parts of their own robot.
        reduce: of several contacts, their "net" force, or the force of the "strongest" one. Within one subtree, as in
            self-collisions, each contact's direction is arbitrary, so only "strongest" has a meaning.
        every_substep: read at each physics substep, not only at the last one of an env step: the clocks run in physics
            steps, and `ContactState.force_history_ESN3` holds the force of each substep.
    """

    against: str | None = "terrain"
    reduce: Literal["net", "strongest"] = "net"
    every_substep: bool = False

    def __post_init__(self) -> None:
        # A tuple of names would fail only deep inside of MuJoCo.
        if isinstance(self.against, (list, tuple)):
            raise ValueError(
                f"against={self.against!r}: a contact sensor takes one {self.against_kind} there, not several: name a "
                "body or subtree that holds them (against_kind), None for anything, or give one sensor each, or "
                "ContactPoints"
            )
        super().__post_init__()
        # Within one subtree each contact's direction is arbitrary, so that a sum means nothing.
        within_one = self.against_kind == "subtree" and self.against in self.subtrees
        if within_one and self.reduce == "net":
            raise ValueError(
                f"reduce='net' with against={self.against!r}, one of the subtrees: forces within one subtree have no "
                "common direction; use reduce='strongest'"
            )

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add one MJCF contact sensor `<name>_<element>` per element."""
        if self.reduce == "net":
            intprm = NET
        else:
            intprm = STRONGEST
        # One per element: MuJoCo's sensor reports one element's contacts.
        for element in self.elements_of(spec, name):
            called = f"{name}_{element}"
            self.add_contacts(
                spec, name, of=element, against=self.against, intprm=intprm, called=called
            )

    def track(self, name: str, view: WorldView) -> "ContactTracker":
        return ContactTracker(name, self, view)


class ContactState(NamedTuple):
    """Contact of a sensor's N elements, float32, after the last substep (acceleration stage); 0 in rows just reset."""

    found_EN: Float[Tensor, "E N"]
    """1 where the element touches, else 0, [E, N]."""
    force_EN3: Float[Tensor, "E N 3"]
    """Force of the element on the other one, N, world frame, [E, N, 3]: MuJoCo's sign, by which a robot's foot that
    carries weight reads negative z. The force on the element is the opposite."""
    position_EN3: Float[Tensor, "E N 3"]
    """Point of contact (weighted by force if there are several), m, world frame, [E, N, 3]; 0 without contact."""
    air_time_EN: Float[Tensor, "E N"]
    """Time since the element left the ground, s, [E, N]; 0 while it touches."""
    last_air_time_EN: Float[Tensor, "E N"]
    """Time that the last completed flight took up to the reading that saw the landing, s, [E, N]."""
    contact_time_EN: Float[Tensor, "E N"]
    """Time since the element touched down, s, [E, N]; 0 while it is in the air."""
    last_contact_time_EN: Float[Tensor, "E N"]
    """Time that the last completed contact took up to the reading that saw the take-off, s, [E, N]."""
    first_contact_EN: Float[Tensor, "E N"]
    """1 in the env step in which the element touched down, if it still stands at its end, else 0, [E, N]."""
    first_air_EN: Float[Tensor, "E N"]
    """1 in the env step in which the element left the ground, if it still flies at its end, else 0, [E, N]."""
    force_history_ESN3: Float[Tensor, "E S N 3"]
    """`force_EN3` of each substep, oldest first, N, world frame, [E, S, N, 3]; S is 1 without `every_substep`."""

    # A named tuple takes no second base.
    if not TYPE_CHECKING:
        __getattr__ = NearNames.__getattr__


_CLOCKS = tuple(name.removesuffix("_EN") for name in ContactState._fields if name.endswith("_EN"))


class ContactTracker(SensorTracker):
    """Reads one contact sensor once per env step, or at every substep, and runs its clocks."""

    contacts_only = True

    def __init__(self, name: str, sensor: ContactSensor, view: WorldView) -> None:
        self._key = f"contact/{name}"
        self._world = view.world
        self._view = view
        self._strongest = sensor.reduce == "strongest"
        elements = sensor.elements(view.resolver.names(ELEMENT_TABLES[sensor.kind]))
        self._count = len(elements)
        names = [f"{name}_{element}" for element in elements]
        # All numbers of all elements, in one index, so that one gather reads them.
        self._columns = columns_of(view, names)
        self._clocks = {
            clock: view.buffers.get(f"{self._key}.{clock}", self._count) for clock in _CLOCKS
        }
        self._history_ESN3: Tensor | None = None
        self._substep = 0
        if sensor.every_substep:
            # Env steps are whole numbers of substeps; the quotient may be rounded.
            substeps = round(view.step_dt / view.physics_dt)
            self._history_ESN3 = view.buffers.get(
                f"{self._key}.force_history", substeps, self._count, 3
            )
            self.every_substep = True

    def update(self) -> None:
        """Advance the clocks by one env step, unless they ran with the substeps."""
        # With `every_substep` the clocks have run already.
        if self._history_ESN3 is None:
            self._advance(self._readings(), self._view.step_dt, starts=True)

    @property
    def state(self) -> ContactState:
        """The contacts of the last env step."""
        cache = self._view.cache
        # Once per state, however many terms read it.
        if self._key not in cache:
            readings = self._readings()
            force_EN3 = self._force(readings)
            cache[self._key] = ContactState(
                force_EN3=force_EN3,
                position_EN3=readings[..., 4:7],
                force_history_ESN3=force_EN3[:, None]
                if self._history_ESN3 is None
                else self._history_ESN3,
                **{f"{clock}_EN": value_EN for clock, value_EN in self._clocks.items()},
            )
        return cache[self._key]

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw an arrow for each contact: the force on the element, from the point of contact."""
        state = self.state
        model = self._world.mj_model
        # m per newton, as in MuJoCo's own viewer.
        scale = model.vis.map.force / model.stat.meanmass
        forces_N3 = state.force_EN3[env_index].cpu().numpy()
        positions_N3 = state.position_EN3[env_index].cpu().numpy()
        for force_3, position_3 in zip(forces_N3, positions_N3, strict=True):
            # Only elements that touch.
            if np.linalg.norm(force_3) > 0.0:
                # MuJoCo's sign is the force of the element; the arrow shows the force on it.
                visualizer.arrow(position_3, position_3 - scale * force_3, rgba=_RGBA, width=0.01)

    def update_substep(self) -> None:
        """Advance the clocks by one substep, and keep its forces."""
        assert self._history_ESN3 is not None
        readings = self._readings()
        # Events of the env step start again at its first substep.
        self._advance(readings, self._view.physics_dt, starts=self._substep == 0)
        # A world that fails in this substep must not leave its numbers to the terms that run after it was cleared.
        force_EN3 = torch.nan_to_num(self._force(readings), nan=0.0, posinf=0.0, neginf=0.0)
        self._history_ESN3[:, self._substep] = force_EN3
        # Round again with the next env step.
        self._substep = (self._substep + 1) % self._history_ESN3.shape[1]

    def _advance(self, readings: Tensor, dt: float, *, starts: bool) -> None:
        """Let `dt` seconds pass; `starts` where this begins an env step."""
        clock = self._clocks
        # MuJoCo's "found" counts contacts; more than 0 is a touch.
        touches = readings[..., 0] > 0
        touched = clock["found"] > 0
        lands = touches & ~touched
        leaves = touched & ~touches
        # As if it went on flying, or standing; used only where it does, or where that ends just now.
        flight_EN = clock["air_time"] + dt
        # A part that stands on the ground at the start of an episode has not flown.
        ends_flight = lands & (clock["air_time"] > 0)
        clock["last_air_time"].copy_(torch.where(ends_flight, flight_EN, clock["last_air_time"]))
        stance_EN = clock["contact_time"] + dt
        clock["last_contact_time"].copy_(torch.where(leaves, stance_EN, clock["last_contact_time"]))
        clock["air_time"].copy_(torch.where(touches, 0.0, flight_EN))
        clock["contact_time"].copy_(torch.where(touches, stance_EN, 0.0))
        # Last, since `touched` is read from it.
        clock["found"].copy_(touches)
        self._keep_event(clock["first_contact"], lands, touches, starts=starts)
        self._keep_event(clock["first_air"], leaves, ~touches, starts=starts)

    def _keep_event(
        self, event_EN: Tensor, happens: Tensor, lasts: Tensor, *, starts: bool
    ) -> None:
        """Note what happens, in whichever substep of the env step, as long as the state that it began lasts."""
        # Events of the env step before are over.
        if not starts:
            happens = happens | (event_EN > 0)
        event_EN.copy_(happens & lasts)

    def _readings(self) -> Tensor:
        """Return found, force, position and (for the strongest) the contact's first two axes: 7 or 13 numbers."""
        return self._world.sensordata_EL[:, self._columns].unflatten(1, (self._count, -1))

    def _force(self, readings: Tensor) -> Tensor:
        if not self._strongest:
            return readings[..., 1:4]
        # The strongest contact's force is in the contact's frame.
        return from_contact(
            readings[..., 1:4], normal=readings[..., 7:10], tangent=readings[..., 10:13]
        )


def columns_of(view: WorldView, names: Sequence[str]) -> Index:
    """Return the columns of `sensordata` [E, L] that hold all numbers of the model's sensors of these names."""
    columns: list[int] = []
    for name in names:
        sensor = view.world.mj_model.sensor(name)
        first = int(sensor.adr[0])
        columns += range(first, first + int(sensor.dim[0]))
    return as_index(columns, view.device)


def from_contact(
    vector: Float[Tensor, "*batch 3"],
    *,
    normal: Float[Tensor, "*batch 3"],
    tangent: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch 3"]:
    """Return vectors in world axes that are given in the contacts' own axes; the first two of these axes are given."""
    # Columns are the contact's axes in the world; the third one follows from the first two.
    axes = torch.stack((normal, tangent, torch.linalg.cross(normal, tangent)), dim=-1)
    return product(axes, vector[..., None])[..., 0]
