"""The kinds of ground: each is a rule that gives the heights of a square patch at a difficulty."""

import math
from dataclasses import dataclass

import numpy as np

from ksim_rl.checked import NonNegative, NonNegativeRange, Positive, Within
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


@dataclass(frozen=True, kw_only=True)
class FlatPatch(TerrainPatch):
    """Even ground at every difficulty."""

    cell: Cell = 1.0

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        return np.zeros_like(lattice.x_RC)


@dataclass(frozen=True, kw_only=True)
class RoughGround(TerrainPatch):
    """Heights drawn independently and uniformly from [-amplitude, amplitude] at points `cell` apart."""

    amplitude: EasyToHard = (0.01, 0.06)
    cell: Cell = 0.15

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        # One draw per lattice point; between points the ground is straight.
        return between(self.amplitude, difficulty) * rng.uniform(-1.0, 1.0, lattice.x_RC.shape)


@dataclass(frozen=True, kw_only=True)
class Waves(TerrainPatch):
    """Two crossed standing waves: amplitude / 2 * (cos(2 pi x / length) + cos(2 pi y / length))."""

    amplitude: EasyToHard = (0.02, 0.2)
    wave_length: float = 2.0
    cell: Cell = 0.2

    def _check_fields(self) -> None:
        super()._check_fields()
        # Fewer than four cells per wave would not show its shape.
        check_in_range("wave_length", self.wave_length, low=4 * self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        # Radians per metre of wave.
        per_metre = 2 * math.pi / self.wave_length
        crests_RC = np.cos(per_metre * lattice.x_RC) + np.cos(per_metre * lattice.y_RC)
        # Two waves add up to twice the amplitude where crests meet.
        return between(self.amplitude, difficulty) / 2 * crests_RC


@dataclass(frozen=True, kw_only=True)
class PyramidSlope(TerrainPatch):
    """A square pyramid with a platform on top; `inverted`, a pit with the platform at its bottom.

    Envs start on the platform: they walk down a pyramid, and up out of a pit. The `gradient` is rise over run (the
    tangent of the slope's angle).
    """

    gradient: EasyToHard = (0.0, 0.5)
    platform_width: Positive = 2.0
    inverted: bool = False
    cell: Cell = 0.25

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        # Horizontal distance from the platform's edge.
        run_RC = np.maximum(lattice.ring_RC - self.platform_width / 2, 0.0)
        return between(self.gradient, difficulty) * (run_RC if self.inverted else -run_RC)


@dataclass(frozen=True, kw_only=True)
class PyramidStairs(TerrainPatch):
    """A square pyramid of steps with a platform on top; `inverted`, a pit with the platform at its bottom.

    Envs start on the platform: they walk down a pyramid, and up out of a pit. Each riser is one `cell` wide, and
    `step_width` reaches from one to the next; there are as many steps as fit.
    """

    step_height: EasyToHard = (0.02, 0.2)
    step_width: float = 0.3
    platform_width: Positive = 2.0
    inverted: bool = False
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        # A riser and a tread take at least a cell each.
        check_in_range("step_width", self.step_width, low=2 * self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        # In steps from the platform's edge; a tie counts as inside.
        from_platform_RC = (lattice.ring_RC - self.platform_width / 2 - TIE) / self.step_width
        # Steps that fit between the platform and the edge of the patch.
        num_steps = int((lattice.size - self.platform_width) / 2 / self.step_width)
        step_RC = np.clip(np.ceil(from_platform_RC), 0, num_steps)
        return between(self.step_height, difficulty) * (step_RC if self.inverted else -step_RC)


@dataclass(frozen=True, kw_only=True)
class DiscreteObstacles(TerrainPatch):
    """Blocks and pits of `height`, edges drawn from `width`, around an even platform; later ones cover earlier ones."""

    height: EasyToHard = (0.02, 0.2)
    width: NonNegativeRange = (0.3, 1.0)
    num_obstacles: Pieces = 60
    platform_width: NonNegative = 1.5

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        height = between(self.height, difficulty)
        reach = lattice.size / 2
        ground_RC = np.zeros_like(lattice.x_RC)
        for _ in range(self.num_obstacles):
            # Half edges and centre of a block, m.
            half_x, half_y = rng.uniform(*self.width, size=2) / 2
            x, y = rng.uniform(-reach, reach, size=2)
            in_x_RC = np.abs(lattice.x_RC - x) <= half_x
            in_y_RC = np.abs(lattice.y_RC - y) <= half_y
            inside_RC = in_x_RC & in_y_RC
            # A block or a pit, with even chances; it replaces what lay there.
            ground_RC[inside_RC] = rng.choice((-height, height))
        # Envs start on the platform, whatever was drawn there.
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC


@dataclass(frozen=True, kw_only=True)
class SteppingStones(TerrainPatch):
    """Square stones in rows and columns around a platform, with holes between them.

    The flanks of stones are one `cell` wide, within the gaps, and all lengths are whole cells. Widths and gaps are
    of the stones' tops, whose heights are drawn from [-unevenness, unevenness].
    """

    stone_width: EasyToHard = (0.8, 0.35)
    gap: EasyToHard = (0.1, 0.3)
    unevenness: EasyToHard = (0.0, 0.05)
    depth: NonNegative = 0.5
    platform_width: NonNegative = 1.5
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        Within(low=self.cell).check("stone_width", self.stone_width)
        # A gap holds two flanks, each a cell wide.
        Within(low=2 * self.cell).check("gap", self.gap)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        cell = lattice.spacing
        # In whole cells, so that all stones of a patch have the same width.
        width = max(1, round(between(self.stone_width, difficulty) / cell))
        gap = max(2, round(between(self.gap, difficulty) / cell))
        place_C = np.arange(lattice.num_cells + 1)
        # Which stone each lattice line belongs to, and where within the period it lies.
        stone_C = place_C // (width + gap)
        within_C = place_C % (width + gap)
        # Both edges of a stone's top belong to it, hence at most.
        on_stone_C = within_C <= width
        unevenness = between(self.unevenness, difficulty)
        # One height per stone.
        tops = rng.uniform(-unevenness, unevenness, size=(stone_C[-1] + 1,) * 2)
        # A point is on a stone if both its row and its column are.
        on_stone_RC = on_stone_C[:, None] & on_stone_C
        top_RC = tops[stone_C[:, None], stone_C[None, :]]
        ground_RC = np.where(on_stone_RC, top_RC, -self.depth)
        ground_RC[lattice.ring_RC <= self.platform_width / 2 + TIE] = 0.0
        return ground_RC


@dataclass(frozen=True, kw_only=True)
class Gaps(TerrainPatch):
    """Square trenches around a platform, one after the other, with even ground between them.

    The flanks of a trench are one `cell` wide, and all lengths are whole cells; `width` reaches from brink to brink,
    `spacing` from one trench to the next.
    """

    width: EasyToHard = (0.1, 0.6)
    spacing: float = 0.8
    depth: NonNegative = 0.5
    platform_width: Positive = 1.5
    cell: Cell = 0.05

    def _check_fields(self) -> None:
        super()._check_fields()
        Within(low=2 * self.cell).check("width", self.width)
        check_in_range("spacing", self.spacing, low=self.cell)

    def heights(self, lattice: Lattice, difficulty: float, rng: np.random.Generator) -> np.ndarray:
        cell = lattice.spacing
        # In whole cells, m.
        width = max(2, round(between(self.width, difficulty) / cell)) * cell
        ground = max(1, round(self.spacing / cell)) * cell
        outside_RC = lattice.ring_RC - round(self.platform_width / 2 / cell) * cell
        # Position within the period of a trench and the ground after it.
        place_RC = np.mod(outside_RC, width + ground)
        # Edges belong to the flat ground.
        in_gap_RC = (outside_RC > TIE) & (place_RC > TIE) & (place_RC < width - TIE)
        return np.where(in_gap_RC, -self.depth, 0.0)
