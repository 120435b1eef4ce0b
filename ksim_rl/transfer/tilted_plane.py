"""A plane that rises along x, on which robots start, facing whichever way."""

import math
from dataclasses import dataclass

import mujoco

from ksim_rl.checked import Positive
from ksim_rl.scene.terrains import PlaneTerrain
from ksim_rl.scene.terrains.terrain import BODY


@dataclass(frozen=True, kw_only=True)
class TiltedPlane(PlaneTerrain):
    """A plane through the origin that rises along x by `degrees`; heights above the ground count as on a level one."""

    degrees: Positive

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add body, geom and looks to the scene's spec."""
        super().add_to(spec)
        half = 0.5 * math.radians(self.degrees)
        # About y, against the positive sense: z grows with x.
        spec.body(BODY).quat = [math.cos(half), 0.0, -math.sin(half), 0.0]
