"""More kinds of ground: hills, squares, rings and beams that one has to step from one to the next."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ksim_rl.checked import Count, NonNegative, NonNegativeRange, Positive, Repeats, Share, Within
from ksim_rl.checks import check_in_range
from ksim_rl.scene.terrains.patch import (
    TIE,
    Cell,
    EasyToHard,
    Lattice,
    Pieces,
    TerrainPatch,
    between,
)


def in_cells(length: float, lattice: Lattice, *, least: int) -> int:
    """Return a length, m, in whole cells, at least so many."""
    return max(least, round(length / lattice.spacing))


@dataclass(frozen=True, kw_only=True)
class PerlinNoise(TerrainPatch):
    """Hills and hollows of several sizes: fractal gradient noise, `height` from the lowest point to the highest.

    Hills of the first octave are `wave_length` apart; each further octave has `persistence` of the height, and half of
    the length, of the one before it (Perlin, "An image synthesizer", 1985, with the fade of 2002).
    """

    height: EasyToHard = (0.05, 0.4)
    wave_length: Positive = 3.0
    octaves: Count = 3
    persistence: Share = 0.5
    cell: Cell = 0.15

    def _check_fields(self) -> None:
        super()._check_fields()
        # Less than two cells per wave of the last octave would be noise without a shape.
        finest = self.wave_length * 0.5 ** (self.octaves - 1)
        if finest < 2 * self.cell:
            raise ValueError(
                f"octaves={self.octaves} of wave_length={self.wave_length}: the last one's waves of {finest:g} m need "
                f"a cell of {finest / 2:g} at most; it is {self.cell}"
            )

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        noise_RC = np.zeros_like(lattice.x_RC)
        for octave in range(self.octaves):
            noise_RC += self.persistence**octave * _gradient_noise(
                lattice, self.wave_length / 2**octave, rng
            )
        span = np.ptp(noise_RC)
        return between(self.height, difficulty) * (noise_RC - noise_RC.min()) / span


def _gradient_noise(lattice: Lattice, length: float, rng: np.random.Generator) -> np.ndarray:
    """Return noise that is 0, with a random slope, at points `length` apart from the patch's corner on; [R, C]."""
    x_RC = (lattice.x_RC + lattice.size / 2) / length
    y_RC = (lattice.y_RC + lattice.size / 2) / length
    # A unit gradient at each point of the coarse grid.
    points = math.ceil(lattice.size / length) + 2
    angle = rng.uniform(0.0, 2 * math.pi, (points, points))
    left_RC = np.floor(x_RC).astype(int)
    below_RC = np.floor(y_RC).astype(int)
    # The fade's first two derivatives vanish at the grid's points.
    along_RC = _fade(x_RC - left_RC)
    up_RC = _fade(y_RC - below_RC)
    noise_RC = np.zeros_like(x_RC)
    for right in (0, 1):
        for above in (0, 1):
            slope_RC = angle[below_RC + above, left_RC + right]
            dx_RC = x_RC - left_RC - right
            dy_RC = y_RC - below_RC - above
            # The plane of this corner, weighted by how near the corner is.
            plane_RC = np.cos(slope_RC) * dx_RC + np.sin(slope_RC) * dy_RC
            weight_x_RC = along_RC if right else 1.0 - along_RC
            weight_y_RC = up_RC if above else 1.0 - up_RC
            noise_RC += weight_x_RC * weight_y_RC * plane_RC
    return noise_RC


def _fade(share: np.ndarray) -> np.ndarray:
    return share**3 * (share * (share * 6.0 - 15.0) + 10.0)


@dataclass(frozen=True, kw_only=True)
class RandomStairs(TerrainPatch):
    """A square pit of steps around a platform at its bottom, each riser drawn from [least_share, 1] of `step_height`.

    Each riser is one `cell` wide, and `step_width` reaches from one to the next; there are as many as fit.
    """

    step_height: EasyToHard = (0.1, 0.25)
    least_share: Share = 0.3
    step_width: float = 0.6
    platform_width: Positive = 2.0
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        # A riser and a tread take at least a cell each.
        check_in_range("step_width", self.step_width, low=2 * self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        num_steps = int((lattice.size - self.platform_width) / 2 / self.step_width)
        risers = between(self.step_height, difficulty) * rng.uniform(
            self.least_share, 1.0, num_steps
        )
        # Treads are as high as all risers below them together; the platform is the first.
        tread = np.concatenate(([0.0], np.cumsum(risers)))
        from_platform_RC = (lattice.ring_RC - self.platform_width / 2 - TIE) / self.step_width
        return tread[np.clip(np.ceil(from_platform_RC), 0, num_steps).astype(int)]


@dataclass(frozen=True, kw_only=True)
class RandomGrid(TerrainPatch):
    """Squares in rows and columns, each at a height drawn from [-amplitude, amplitude], around an even platform.

    Between two squares the ground rises within one `cell`; squares have a whole number of cells.
    """

    amplitude: EasyToHard = (0.02, 0.2)
    square_width: float = 0.45
    platform_width: NonNegative = 1.5
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        check_in_range("square_width", self.square_width, low=2 * self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        amplitude = between(self.amplitude, difficulty)
        square_C = _squares(lattice, self.square_width)
        tops = rng.uniform(-amplitude, amplitude, size=(square_C[-1] + 1,) * 2)
        ground_RC = tops[square_C[:, None], square_C[None, :]]
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC


def _squares(lattice: Lattice, width: float) -> np.ndarray:
    """Return which square along an edge each lattice line belongs to, int [C]."""
    return np.arange(lattice.num_cells + 1) // in_cells(width, lattice, least=2)


@dataclass(frozen=True, kw_only=True)
class TiltedGrid(TerrainPatch):
    """Squares in rows and columns, each a slope of its own, around an even platform.

    Angles about x and about y are drawn from [-tilt, tilt] (degrees), heights of the middles from [-amplitude,
    amplitude]. Between two squares the ground rises within one `cell`; squares have a whole number of cells.
    """

    tilt: Annotated[tuple[float, float], Within(low=0.0, high=60.0)] = (0.0, 15.0)
    amplitude: EasyToHard = (0.0, 0.05)
    square_width: float = 1.0
    platform_width: NonNegative = 1.0
    cell: Cell = 0.1

    def _check_fields(self) -> None:
        super()._check_fields()
        check_in_range("square_width", self.square_width, low=2 * self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        square_C = _squares(lattice, self.square_width)
        shape = (square_C[-1] + 1,) * 2
        tilt = math.radians(between(self.tilt, difficulty))
        amplitude = between(self.amplitude, difficulty)
        middle = rng.uniform(-amplitude, amplitude, shape)
        along_x, along_y = np.tan(rng.uniform(-tilt, tilt, (2, *shape)))
        # Distance of each lattice line from the middle of its square, m.
        cells = in_cells(self.square_width, lattice, least=2)
        from_middle_C = (
            np.arange(lattice.num_cells + 1) % cells - (cells - 1) / 2
        ) * lattice.spacing
        place = (square_C[:, None], square_C[None, :])
        ground_RC = (
            middle[place] + along_x[place] * from_middle_C + along_y[place] * from_middle_C[:, None]
        )
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC


@dataclass(frozen=True, kw_only=True)
class RandomBoxes(TerrainPatch):
    """Boxes that lie about on even ground, turned at random, around an even platform; later ones cover earlier ones.

    Edges are drawn from `width`, heights from [least_share, 1] of `height`.
    """

    height: EasyToHard = (0.05, 0.3)
    least_share: Share = 0.2
    width: NonNegativeRange = (0.3, 1.0)
    num_boxes: Pieces = 60
    platform_width: NonNegative = 1.5

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        highest = between(self.height, difficulty)
        reach = lattice.size / 2
        ground_RC = np.zeros_like(lattice.x_RC)
        for _ in range(self.num_boxes):
            half_length, half_width = rng.uniform(*self.width, size=2) / 2
            x, y = rng.uniform(-reach, reach, size=2)
            angle = rng.uniform(0.0, 2 * math.pi)
            # Each point in the axes of the box.
            dx_RC = lattice.x_RC - x
            dy_RC = lattice.y_RC - y
            along_RC = math.cos(angle) * dx_RC + math.sin(angle) * dy_RC
            across_RC = math.cos(angle) * dy_RC - math.sin(angle) * dx_RC
            inside_RC = (np.abs(along_RC) <= half_length) & (np.abs(across_RC) <= half_width)
            ground_RC[inside_RC] = highest * rng.uniform(self.least_share, 1.0)
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC


@dataclass(frozen=True, kw_only=True)
class NestedRings(TerrainPatch):
    """Square rings around a platform, with trenches between them, all tops at one height above the platform.

    The flanks of a trench are one `cell` wide, within it; all lengths are whole cells.
    """

    ring_width: EasyToHard = (0.6, 0.3)
    gap: EasyToHard = (0.1, 0.3)
    height: NonNegative = 0.1
    depth: NonNegative = 0.5
    platform_width: Positive = 1.5
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        Within(low=self.cell).check("ring_width", self.ring_width)
        Within(low=2 * self.cell).check("gap", self.gap)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        ring = in_cells(between(self.ring_width, difficulty), lattice, least=1)
        gap = in_cells(between(self.gap, difficulty), lattice, least=2)
        platform = in_cells(self.platform_width / 2, lattice, least=1)
        # Whole cells from the centre; the rounding takes care of coordinates that are a little off.
        from_platform_RC = np.rint(lattice.ring_RC / lattice.spacing).astype(int) - platform
        # Both brinks of a trench belong to the ground on either side.
        place_RC = from_platform_RC % (gap + ring)
        in_gap_RC = (from_platform_RC > 0) & (place_RC > 0) & (place_RC < gap)
        ground_RC = np.where(from_platform_RC <= 0, 0.0, self.height)
        return np.where(in_gap_RC, -self.depth, ground_RC)


@dataclass(frozen=True, kw_only=True)
class NarrowBeams(TerrainPatch):
    """Beams that lead from an even platform outwards, like spokes, evenly spaced, over a pit."""

    beam_width: EasyToHard = (0.5, 0.25)
    num_beams: Repeats = 8
    depth: NonNegative = 0.5
    platform_width: Positive = 1.5
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        Within(low=2 * self.cell).check("beam_width", self.beam_width)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        half = between(self.beam_width, difficulty) / 2
        ground_RC = np.full_like(lattice.x_RC, -self.depth)
        for beam in range(self.num_beams):
            angle = 2 * math.pi * beam / self.num_beams
            ahead_RC = math.cos(angle) * lattice.x_RC + math.sin(angle) * lattice.y_RC
            aside_RC = math.cos(angle) * lattice.y_RC - math.sin(angle) * lattice.x_RC
            ground_RC[(ahead_RC >= 0.0) & (np.abs(aside_RC) <= half + TIE)] = 0.0
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC
