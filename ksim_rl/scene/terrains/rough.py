"""Rough ground: noise."""

from dataclasses import dataclass

import numpy as np

from ksim_rl.scene.terrains.patch import (
    Lattice,
    TerrainPatch,
    between,
    check_ends,
)


@dataclass(frozen=True, kw_only=True)
class RoughGround(TerrainPatch):
    """Heights drawn independently and uniformly from [-amplitude, amplitude] at points `cell` apart.

    Attributes:
        amplitude: m, at difficulty 0 and 1.
    """

    amplitude: tuple[float, float] = (0.01, 0.06)
    cell: float = 0.15

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("amplitude", self.amplitude, low=0.0)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]."""
        return between(self.amplitude, difficulty) * rng.uniform(-1.0, 1.0, lattice.x_RC.shape)
