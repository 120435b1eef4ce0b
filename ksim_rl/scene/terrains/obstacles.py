"""Blocks and pits scattered over even ground."""

from dataclasses import dataclass

import numpy as np

from ksim_rl.checks import check_in_range, check_pair
from ksim_rl.scene.terrains.patch import (
    TIE,
    Lattice,
    TerrainPatch,
    between,
    check_ends,
)


@dataclass(frozen=True, kw_only=True)
class DiscreteObstacles(TerrainPatch):
    """Rectangular blocks and pits at random places, around an even platform; later ones cover earlier ones.

    Attributes:
        height: m of blocks, and depth of pits, at difficulty 0 and 1.
        width: edges are drawn from this range, m.
        num_obstacles: how many there are.
        platform_width: edge of the platform, m.
    """

    height: tuple[float, float] = (0.02, 0.2)
    width: tuple[float, float] = (0.3, 1.0)
    num_obstacles: int = 60
    platform_width: float = 1.5
    cell: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("height", self.height, low=0.0)
        check_pair("width", self.width, low=0.0)
        check_in_range("num_obstacles", self.num_obstacles, low=0)
        check_in_range("platform_width", self.platform_width, low=0.0)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]."""
        height, reach = between(self.height, difficulty), lattice.size / 2
        ground_RC = np.zeros_like(lattice.x_RC)
        for _ in range(self.num_obstacles):
            half_x, half_y = rng.uniform(*self.width, size=2) / 2
            x, y = rng.uniform(-reach, reach, size=2)
            inside_RC = (np.abs(lattice.x_RC - x) <= half_x) & (np.abs(lattice.y_RC - y) <= half_y)
            ground_RC[inside_RC] = rng.choice((-height, height))
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC
