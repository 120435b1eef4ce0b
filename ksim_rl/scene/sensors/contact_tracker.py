"""Reads a contact sensor, and runs the clocks of contact and flight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.scene.names import as_index
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors.sensor import SensorTracker, sensor_columns
from ksim_rl.scene.small_matrices import product
from ksim_rl.scene.state.world_view import WorldView

_RGBA = (1.0, 0.55, 0.1, 1.0)


class ContactState(NamedTuple):
    """Contact of the N elements of a sensor, at the end of the last physics substep (acceleration stage).

    All are float32, and rows that were just reset read zero.
    """

    found_EN: Float[Tensor, "E N"]
    """1 where the element touches, else 0, [E, N]."""
    force_EN3: Float[Tensor, "E N 3"]
    """Force of the element on what it touches, N, world frame, [E, N, 3]: MuJoCo's sign, by which a robot's foot that
    carries weight reads negative z. The force on the element is the opposite."""
    position_EN3: Float[Tensor, "E N 3"]
    """Point of contact (weighted by force if there are several), m, world frame, [E, N, 3]; 0 without contact."""
    air_time_EN: Float[Tensor, "E N"]
    """Seconds since the element left the ground, [E, N]; 0 while it touches."""
    last_air_time_EN: Float[Tensor, "E N"]
    """Seconds that the last completed flight took, [E, N]."""
    contact_time_EN: Float[Tensor, "E N"]
    """Seconds since the element touched down, [E, N]; 0 while it is in the air."""
    last_contact_time_EN: Float[Tensor, "E N"]
    """Seconds that the last completed contact took, [E, N]."""
    first_contact_EN: Float[Tensor, "E N"]
    """1 in the env step in which the element touched down, else 0, [E, N]."""
    first_air_EN: Float[Tensor, "E N"]
    """1 in the env step in which the element left the ground, else 0, [E, N]."""
    force_history_ESN3: Float[Tensor, "E S N 3"]
    """`force_EN3` of each substep of the env step, oldest first, [E, S, N, 3]; S is 1 without `every_substep`."""


class ContactTracker(SensorTracker):
    """Reads one contact sensor once per env step, or at every substep, and runs its clocks."""

    def __init__(
        self, name: str, view: WorldView, *, elements: Sequence[str], strongest: bool, every_substep: bool
    ) -> None:
        self._key = f"contact/{name}"
        self._world, self._view, self._strongest = view.world, view, strongest
        self._count = len(elements)
        columns = [
            address
            for element in elements
            for address in sensor_columns(self._world.mj_model, f"{name}_{element}")
        ]
        self._columns = as_index(columns, view.device)
        self._clocks = {
            clock: view.buffers.get(f"{self._key}.{clock}", self._count)
            for clock in (
                "found",
                "air_time",
                "last_air_time",
                "contact_time",
                "last_contact_time",
                "first_contact",
                "first_air",
            )
        }
        self._history_ESN3: Tensor | None = None
        self._substep = 0
        if every_substep:
            substeps = round(view.step_dt / view.physics_dt)
            self._history_ESN3 = view.buffers.get(f"{self._key}.force_history", substeps, self._count, 3)
            self.every_substep = True

    def update(self) -> None:
        """Advance the clocks by one env step, unless they ran with the substeps."""
        if self._history_ESN3 is None:
            self._advance(self._readings(), self._view.step_dt, starts=True)

    @property
    def state(self) -> ContactState:
        """The contacts of the last env step."""
        clock, cache, history_ESN3 = self._clocks, self._view.cache, self._history_ESN3
        force_EN3, position_EN3 = cache.get(f"{self._key}.force"), cache.get(f"{self._key}.position")
        if force_EN3 is None or position_EN3 is None:
            readings = self._readings()
            force_EN3 = cache[f"{self._key}.force"] = self._force(readings)
            position_EN3 = cache[f"{self._key}.position"] = readings[..., 4:7]
        return ContactState(
            found_EN=clock["found"],
            force_EN3=force_EN3,
            position_EN3=position_EN3,
            air_time_EN=clock["air_time"],
            last_air_time_EN=clock["last_air_time"],
            contact_time_EN=clock["contact_time"],
            last_contact_time_EN=clock["last_contact_time"],
            first_contact_EN=clock["first_contact"],
            first_air_EN=clock["first_air"],
            force_history_ESN3=force_EN3[:, None] if history_ESN3 is None else history_ESN3,
        )

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw an arrow for each contact: the force on the element, from the point of contact."""
        state, model = self.state, self._world.mj_model
        # m per newton, as in MuJoCo's own viewer.
        scale = model.vis.map.force / model.stat.meanmass
        forces_N3 = state.force_EN3[env_index].cpu().numpy()
        positions_N3 = state.position_EN3[env_index].cpu().numpy()
        for force_3, position_3 in zip(forces_N3, positions_N3, strict=True):
            if np.linalg.norm(force_3) > 0.0:
                visualizer.arrow(position_3, position_3 - scale * force_3, rgba=_RGBA, width=0.01)

    def update_substep(self) -> None:
        """Advance the clocks by one substep, and keep its forces."""
        assert self._history_ESN3 is not None
        readings = self._readings()
        self._advance(readings, self._view.physics_dt, starts=self._substep == 0)
        # A world that fails in this substep must not leave its numbers to the terms that run after it was cleared.
        force_EN3 = torch.nan_to_num(self._force(readings), nan=0.0, posinf=0.0, neginf=0.0)
        self._history_ESN3[:, self._substep] = force_EN3
        self._substep = (self._substep + 1) % self._history_ESN3.shape[1]

    def _advance(self, readings: Tensor, dt: float, *, starts: bool) -> None:
        """Let `dt` seconds pass; `starts` where this begins an env step."""
        clock = self._clocks
        touches = readings[..., 0] > 0
        touched = clock["found"] > 0
        lands, leaves = touches & ~touched, touched & ~touches
        flight_EN = clock["air_time"] + dt
        # What stands on the ground at the start of an episode has not flown.
        ends_flight = lands & (clock["air_time"] > 0)
        clock["last_air_time"].copy_(torch.where(ends_flight, flight_EN, clock["last_air_time"]))
        clock["last_contact_time"].copy_(
            torch.where(leaves, clock["contact_time"], clock["last_contact_time"])
        )
        clock["air_time"].copy_(torch.where(touches, 0.0, flight_EN))
        clock["contact_time"].copy_(torch.where(touches, clock["contact_time"] + dt, 0.0))
        clock["found"].copy_(touches)
        for event, happens in (("first_contact", lands), ("first_air", leaves)):
            clock[event].copy_(happens if starts else torch.where(happens, 1.0, clock[event]))

    def _readings(self) -> Tensor:
        """Return found, force, position and (for the strongest) the contact's first two axes, [E, N, 7 or 13]."""
        return self._world.sensordata_EL[:, self._columns].unflatten(1, (self._count, -1))

    def _force(self, readings: Tensor) -> Tensor:
        if not self._strongest:
            return readings[..., 1:4]
        normal, tangent = readings[..., 7:10], readings[..., 10:13]
        axes = torch.stack((normal, tangent, torch.linalg.cross(normal, tangent)), dim=-1)
        return product(axes, readings[..., 1:4, None])[..., 0]
