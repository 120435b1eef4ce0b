"""Stairs around a platform."""

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
class PyramidStairs(TerrainPatch):
    """A square pyramid of steps with a platform on top; inverted, a pit with the platform at its bottom.

    Envs start on the platform: they walk down a pyramid, and up out of a pit. Each riser is one `cell` wide.

    Attributes:
        step_height: m, at difficulty 0 and 1.
        step_width: m from one riser to the next.
        platform_width: edge of the platform, m.
        inverted: a pit instead of a pyramid.
    """

    step_height: tuple[float, float] = (0.02, 0.2)
    step_width: float = 0.3
    platform_width: float = 2.0
    inverted: bool = False
    cell: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ends("step_height", self.step_height, low=0.0)
        check_in_range("step_width", self.step_width, low=2 * self.cell)
        check_in_range("platform_width", self.platform_width, low=0.0, low_open=True)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights, m, [R, C]; as many steps as fit."""
        from_platform_RC = (lattice.ring_RC - self.platform_width / 2 - TIE) / self.step_width
        num_steps = int((lattice.size - self.platform_width) / 2 / self.step_width)
        step_RC = np.clip(np.ceil(from_platform_RC), 0, num_steps)
        return between(self.step_height, difficulty) * (step_RC if self.inverted else -step_RC)
