"""Flat ground without end."""

from dataclasses import dataclass

import mujoco

from ksim_rl.checks import check_in_range
from ksim_rl.scene.terrains.look import add_look
from ksim_rl.scene.terrains.terrain import Terrain, add_ground


@dataclass(frozen=True, kw_only=True)
class PlaneTerrain(Terrain):
    """An infinite plane at z = 0: body and geom are both called "terrain".

    Attributes:
        friction: sliding (1), torsional (m) and rolling (m) coefficients, as in MJCF.
    """

    friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)

    def __post_init__(self) -> None:
        for index, value in enumerate(self.friction):
            check_in_range(f"friction[{index}]", value, low=0.0)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the plane to the world body, with a checker pattern and a sky for rendering."""
        add_look(spec, repeat=2)
        add_ground(spec, friction=self.friction, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.01])
