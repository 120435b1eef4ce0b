"""Even ground, as one kind among others."""

from dataclasses import dataclass

import numpy as np

from ksim_rl.scene.terrains.patch import Lattice, TerrainPatch


@dataclass(frozen=True, kw_only=True)
class FlatPatch(TerrainPatch):
    """Even ground at every difficulty."""

    cell: float = 1.0

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return zeros, [R, C]."""
        return np.zeros_like(lattice.x_RC)
