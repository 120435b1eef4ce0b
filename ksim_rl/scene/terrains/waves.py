"""Waves."""

import math
from dataclasses import dataclass

import numpy as np

from ksim_rl.checks import check_in_range
from ksim_rl.scene.terrains.patch import (
    Lattice,
    TerrainPatch,
    between,
    check_ends,
)


@dataclass(frozen=True, kw_only=True)
class Waves(TerrainPatch):
    """Two crossed standing waves: amplitude / 2 * (cos(2 pi x / length) + cos(2 pi y / length)).

    Attributes:
        amplitude: m, at difficulty 0 and 1; crests are 2 amplitudes above the deepest troughs.
        wave_length: m.
    """

    amplitude: tuple[float, float] = (0.02, 0.2)
    wave_length: float = 2.0
    cell: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("amplitude", self.amplitude, low=0.0)
        check_in_range("wave_length", self.wave_length, low=4 * self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]."""
        per_metre = 2 * math.pi / self.wave_length
        crests_RC = np.cos(per_metre * lattice.x_RC) + np.cos(per_metre * lattice.y_RC)
        return between(self.amplitude, difficulty) / 2 * crests_RC
