"""The planar arm of `reacher.xml`: joints "shoulder" and "wrist" about z, a motor of 0.06 N m each, site "finger".

The finger moves in the plane z = 0.02 m and reaches up to 0.25 m from the hub.
"""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec

PLANE_HEIGHT = 0.02


@dataclass(frozen=True, kw_only=True)
class Reacher:
    """Two links, 0.13 m and 0.12 m, that turn in a horizontal plane."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("reacher.xml").read_text())
