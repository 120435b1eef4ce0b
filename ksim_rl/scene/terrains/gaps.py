"""Gaps to step or jump over."""

from dataclasses import dataclass

import numpy as np

from ksim_rl.checks import check_in_range
from ksim_rl.scene.terrains.patch import (
    TIE,
    Lattice,
    TerrainPatch,
    between,
    check_ends,
)


@dataclass(frozen=True, kw_only=True)
class Gaps(TerrainPatch):
    """Square trenches around a platform, one after the other, with even ground between them.

    The flanks of a trench are one `cell` wide, and all lengths are whole cells.

    Attributes:
        width: m from brink to brink, at difficulty 0 and 1.
        spacing: m of ground between two trenches.
        depth: m.
        platform_width: edge of the platform, m.
    """

    width: tuple[float, float] = (0.1, 0.6)
    spacing: float = 0.8
    depth: float = 0.5
    platform_width: float = 1.5
    cell: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("width", self.width, low=2 * self.cell)
        check_in_range("spacing", self.spacing, low=self.cell)
        check_in_range("depth", self.depth, low=0.0)
        check_in_range("platform_width", self.platform_width, low=0.0, low_open=True)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]."""
        cell = lattice.spacing
        width = max(2, round(between(self.width, difficulty) / cell)) * cell
        ground = max(1, round(self.spacing / cell)) * cell
        outside_RC = lattice.ring_RC - round(self.platform_width / 2 / cell) * cell
        place_RC = np.mod(outside_RC, width + ground)
        in_gap_RC = (outside_RC > TIE) & (place_RC > TIE) & (place_RC < width - TIE)
        return np.where(in_gap_RC, -self.depth, 0.0)
