"""The base of all kinds of ground: a rule gives the heights of a square patch at a difficulty."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from ksim_rl.checked import Checked, Positive, Within

TIE = 1e-6
"""m. Lattice points that lie on an edge of a pattern belong to its inside, whatever the coordinates round to."""


Pieces = Annotated[int, Within(low=0, high=10_000)]
"""How many things are laid on a patch, one after the other."""
Cell = Annotated[float, Within(low=0.01)]
"""m between the points at which heights are given."""
EasyToHard = Annotated[tuple[float, float], Within(low=0.0)]
"""Values at difficulty 0 and 1; either may be the greater one."""


@dataclass(frozen=True)
class Lattice:
    """The points of a square patch at which heights are given; between them the ground is made of triangles.

    The patch has edges of `size`, m, about the origin; points are `cell` apart, or the nearest that divides `size`.
    """

    size: float
    cell: float

    @property
    def num_cells(self) -> int:
        """Cells along one edge."""
        return max(1, round(self.size / self.cell))

    @property
    def spacing(self) -> float:
        """Distance between neighbouring points, m."""
        # The nearest cell size that divides the edge.
        return self.size / self.num_cells

    @cached_property
    def x_RC(self) -> np.ndarray:
        """X of each point, m; columns run along x."""
        # One more point than cells.
        line = np.linspace(-self.size / 2, self.size / 2, self.num_cells + 1)
        return np.broadcast_to(line, (line.size, line.size))

    @property
    def y_RC(self) -> np.ndarray:
        """Return y of each point, m, [R, C]; rows run along y."""
        return self.x_RC.T

    @cached_property
    def ring_RC(self) -> np.ndarray:
        """Distance of each point to the centre, m, [R, C], in the norm whose circles are squares: max(|x|, |y|)."""
        # Squares about the centre, as platforms, pyramids and trenches are.
        return np.maximum(np.abs(self.x_RC), np.abs(self.y_RC))


@dataclass(frozen=True, kw_only=True)
class TerrainPatch(Checked, ABC):
    """A kind of ground. Pairs are values at difficulty 0 and at difficulty 1, with a straight line between them.

    Lengths are in m; `platform_width` is the edge of the even square about the centre, `proportion` the share of envs
    relative to other kinds, `cell` the distance of points at which heights are given. The cost is in the number of
    triangles under a foot, so take the coarsest that shows the shape.
    """

    proportion: Positive = 1.0
    cell: Cell = 0.1

    @abstractmethod
    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        """Return the heights at the points of `lattice`, m, float64 [R, C], for a difficulty in [0, 1].

        Only differences count: a `TerrainGrid` puts the lowest point at z = 0.
        """


def between(pair: tuple[float, float], difficulty: float) -> float:
    """Return the value of a pair at a difficulty in [0, 1]."""
    # Either end may be the greater one.
    return pair[0] + difficulty * (pair[1] - pair[0])
