"""Reads contact sensors from MuJoCo's data, and runs their clocks."""

import mujoco
import numpy as np

from ksim_rl.export.standalone.description import ContactSpec
from ksim_rl.export.standalone.files import Array


class Contacts:
    """The readings of one contact sensor of the export: values by field, one per element, or three.

    `substeps` are the physics steps of an env step, and `refine` into how many each of them is divided.
    """

    def __init__(self, spec: ContactSpec, mj_model: mujoco.MjModel, substeps: int) -> None:
        self.strongest = spec["strongest"]
        self.every = spec["every_substep"]
        # One MuJoCo sensor reads found, force and position (7 numbers); of the strongest
        # contact also normal and tangent (13).
        first = [mj_model.sensor(name).adr[0] for name in spec["elements"]]
        self.index = np.add.outer(first, np.arange(13 if self.strongest else 7))
        self.kept = substeps if self.every else 1
        self.refine = 1
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        count = len(self.index)
        times = ("air_time", "last_air_time", "contact_time", "last_contact_time")
        self.fields: dict[str, Array] = {
            name: np.zeros(count) for name in ("found", "first_contact", "first_air", *times)
        }
        self.fields |= {name: np.zeros((count, 3)) for name in ("force", "position")}
        # The force of each substep, the oldest first; the env's own buffer begins with zeros, too.
        self.fields["force_history"] = np.zeros((self.kept, count, 3))
        self.updates = 0

    def update(self, data: mujoco.MjData, dt: float, starts: bool) -> None:
        """Let `dt` seconds pass; `starts` where this begins an env step."""
        # "found" is needed at the next update, to tell landing from standing.
        reading = data.sensordata[self.index]
        kept = self.fields
        force = reading[:, 1:4]
        # The force of the strongest contact is in the contact's own axes: turn it into the world's.
        if self.strongest:
            normal = reading[:, 7:10]
            tangent = reading[:, 10:13]
            axes = np.stack((normal, tangent, np.cross(normal, tangent)), -1)
            force = np.einsum("nij,nj->ni", axes, force)
        kept["force"] = force
        kept["position"] = reading[:, 4:7]
        # A substep that is divided leaves the force of its last part.
        self.updates = 0 if starts else self.updates + 1
        kept["force_history"][self.updates // self.refine] = force
        # Rising and falling edges of contact.
        touches = reading[:, 0] > 0
        touched = kept["found"] > 0
        lands = touches & ~touched
        leaves = touched & ~touches
        # The time up to and including this update, so that a landing reports the whole flight.
        flight = kept["air_time"] + dt
        stance = kept["contact_time"] + dt
        # Elements that stood from the start have flown for no time: that is no flight.
        kept["last_air_time"] = np.where(
            lands & (kept["air_time"] > 0), flight, kept["last_air_time"]
        )
        kept["last_contact_time"] = np.where(leaves, stance, kept["last_contact_time"])
        kept["air_time"] = np.where(touches, 0.0, flight)
        kept["contact_time"] = np.where(touches, stance, 0.0)
        kept["found"] = touches * 1.0
        # An event of any substep counts for the whole env step, as long as what it began lasts.
        for name, event, lasts in (
            ("first_contact", lands, touches),
            ("first_air", leaves, ~touches),
        ):
            held = 0.0 if starts else kept[name]
            kept[name] = np.maximum(held, event) * lasts
