"""Stepping stones."""

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
class SteppingStones(TerrainPatch):
    """Square stones in rows and columns around a platform, with holes between them.

    The flanks of stones are one `cell` wide, within the gaps, and all lengths are whole cells.

    Attributes:
        stone_width: edge of a stone's top, m, at difficulty 0 and 1.
        gap: m between the tops of neighbouring stones, at difficulty 0 and 1.
        unevenness: tops are drawn from [-unevenness, unevenness], m, at difficulty 0 and 1.
        depth: m of the holes.
        platform_width: edge of the platform, m.
    """

    stone_width: tuple[float, float] = (0.8, 0.35)
    gap: tuple[float, float] = (0.1, 0.3)
    unevenness: tuple[float, float] = (0.0, 0.05)
    depth: float = 0.5
    platform_width: float = 1.5
    cell: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("stone_width", self.stone_width, low=self.cell)
        check_ends("gap", self.gap, low=2 * self.cell)
        check_ends("unevenness", self.unevenness, low=0.0)
        check_in_range("depth", self.depth, low=0.0)
        check_in_range("platform_width", self.platform_width, low=0.0)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]."""
        cell = lattice.spacing
        width = max(1, round(between(self.stone_width, difficulty) / cell))
        gap = max(2, round(between(self.gap, difficulty) / cell))
        place_C = np.arange(lattice.num_cells + 1)
        stone_C, within_C = place_C // (width + gap), place_C % (width + gap)
        on_stone_C = within_C <= width
        unevenness = between(self.unevenness, difficulty)
        tops = rng.uniform(-unevenness, unevenness, size=(stone_C[-1] + 1,) * 2)
        ground_RC = np.where(
            on_stone_C[:, None] & on_stone_C, tops[stone_C[:, None], stone_C[None, :]], -self.depth
        )
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC
