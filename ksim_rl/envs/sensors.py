"""Contact sensors of a scene: MJCF sensors plus the clocks of contact and flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from ksim_rl.checks import near
from ksim_rl.envs.memory import Memory
from ksim_rl.envs.names import as_index
from ksim_rl.physics import World

# Bits of MuJoCo's contact sensor (mjtConDataField) and its reduction "netforce".
_FOUND, _FORCE, _NET_FORCE = 1 << 0, 1 << 1, 3


class ContactState(NamedTuple):
    """Contact of N geoms with one body, at the end of the last physics substep (acceleration stage).

    All are float32 [E, N] unless stated otherwise; rows that were just reset read zero.
    """

    found_EN: Tensor
    """1 where the geom touches, else 0."""
    force_EN3: Tensor
    """Net contact force of the geom on the body, N, [E, N, 3], in the world frame: MuJoCo's sign, so that a robot's
    foot that carries weight reads negative z."""
    air_time_EN: Tensor
    """Seconds since the geom left the ground; 0 while it touches."""
    last_air_time_EN: Tensor
    """Seconds that the last completed flight took."""
    contact_time_EN: Tensor
    """Seconds since the geom touched down; 0 while it is in the air."""
    first_contact_EN: Tensor
    """1 in the env step in which the geom touched down, else 0."""


@dataclass(frozen=True, kw_only=True)
class ContactSensor:
    """Contact of some geoms with one body.

    Attributes:
        geoms: names of the geoms, in the order of the N dim.
        body: the body that they touch.
    """

    geoms: tuple[str, ...]
    body: str = "terrain"

    def __post_init__(self) -> None:
        if not self.geoms:
            raise ValueError("geoms=(): name at least one geom")

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the MJCF sensors `<name>_<geom>_found` and `<name>_<geom>_force`.

        Raises:
            ValueError: if the model has no such geom or body.
        """
        for kind, wanted, elements in (("geom", self.geoms, spec.geoms), ("body", (self.body,), spec.bodies)):
            present = [element.name for element in elements if element.name]
            for missing in (item for item in wanted if item not in present):
                raise ValueError(f"scene.sensors.{name}: no {kind} {missing!r}: {near(missing, present)}")
        for geom in self.geoms:
            for suffix, bits in (("found", _FOUND), ("force", _FORCE)):
                spec.add_sensor(
                    name=f"{name}_{geom}_{suffix}",
                    type=mujoco.mjtSensor.mjSENS_CONTACT,
                    objtype=mujoco.mjtObj.mjOBJ_GEOM,
                    objname=geom,
                    reftype=mujoco.mjtObj.mjOBJ_BODY,
                    refname=self.body,
                    intprm=[bits, _NET_FORCE, 1],
                )


class ContactTracker:
    """Reads one `ContactSensor` once per env step and runs its clocks."""

    def __init__(
        self, name: str, sensor: ContactSensor, *, world: World, memories: Memory, step_dt: float
    ) -> None:
        self._world, self._step_dt = world, step_dt
        self._found = self._columns([f"{name}_{geom}_found" for geom in sensor.geoms])
        self._force = self._columns([f"{name}_{geom}_force" for geom in sensor.geoms])
        count = len(sensor.geoms)
        self._clocks = {
            key: memories.get(f"contact/{name}.{key}", count)
            for key in ("found", "air_time", "last_air_time", "contact_time", "first_contact")
        }

    def update(self) -> None:
        """Advance the clocks by one env step, from the sensors of the last substep."""
        clock, dt = self._clocks, self._step_dt
        touches = self._world.sensordata_EL[:, self._found] > 0
        lands = touches & (clock["found"] == 0)
        flight_EN = clock["air_time"] + dt
        # What stands on the ground at the start of an episode has not flown.
        ends_flight = lands & (clock["air_time"] > 0)
        clock["last_air_time"].copy_(torch.where(ends_flight, flight_EN, clock["last_air_time"]))
        clock["air_time"].copy_(torch.where(touches, 0.0, flight_EN))
        clock["contact_time"].copy_(torch.where(touches, clock["contact_time"] + dt, 0.0))
        clock["found"].copy_(touches)
        clock["first_contact"].copy_(lands)

    @property
    def state(self) -> ContactState:
        """The contacts of the last env step."""
        clock = self._clocks
        force_EL = self._world.sensordata_EL[:, self._force]
        return ContactState(
            found_EN=clock["found"],
            force_EN3=force_EL.reshape(force_EL.shape[0], -1, 3),
            air_time_EN=clock["air_time"],
            last_air_time_EN=clock["last_air_time"],
            contact_time_EN=clock["contact_time"],
            first_contact_EN=clock["first_contact"],
        )

    def _columns(self, names: Sequence[str]) -> slice | Tensor:
        model = self._world.mj_model
        columns = []
        for name in names:
            sensor = model.sensor(name)
            columns.extend(range(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0])))
        return as_index(columns, self._world.device)
