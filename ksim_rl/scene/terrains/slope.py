"""Slopes around a platform."""

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
class PyramidSlope(TerrainPatch):
    """A square pyramid with a platform on top; inverted, a pit with the platform at its bottom.

    Envs start on the platform: they walk down a pyramid, and up out of a pit.

    Attributes:
        gradient: rise over run (the tangent of the slope's angle), at difficulty 0 and 1.
        platform_width: edge of the platform, m.
        inverted: a pit instead of a pyramid.
    """

    gradient: tuple[float, float] = (0.0, 0.5)
    platform_width: float = 2.0
    inverted: bool = False
    cell: float = 0.25

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("gradient", self.gradient, low=0.0)
        check_in_range("platform_width", self.platform_width, low=0.0, low_open=True)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]."""
        run_RC = np.maximum(lattice.ring_RC - self.platform_width / 2, 0.0)
        return between(self.gradient, difficulty) * (run_RC if self.inverted else -run_RC)
