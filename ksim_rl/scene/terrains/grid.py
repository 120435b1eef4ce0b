"""Ground in levels of difficulty and columns of kinds; each world has one patch of it to itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.checked import Count, Positive, WholeNumber
from ksim_rl.checks import check_count, check_in_range
from ksim_rl.scene.state.world_view import WorldView
from ksim_rl.scene.terrains.patch import TIE, Lattice, TerrainPatch
from ksim_rl.scene.terrains.patched_ground import GEOM_FIELDS, PatchedGround, patch_name
from ksim_rl.scene.terrains.terrain import Friction, Terrain, add_ground, add_look

BASE = 0.5
"""m of solid ground below the lowest point of a patch."""
THINNEST = 1e-3
"""m between the lowest and the highest point of a patch, at least: MuJoCo wants height fields with some height."""


@dataclass(frozen=True, kw_only=True)
class TerrainGrid(Terrain):
    """`num_levels` x `num_columns` square patches of ground.

    Each world collides with one patch, which lies about that world's origin: the height field of the geom "terrain" is
    chosen per world (`geom_dataid`), so that physics costs what one small patch costs, however many there are. The
    lowest point of a patch is at z = 0. Beyond its edge there is nothing: end episodes there (`mdp.OutsideTerrain`).

    Columns are dealt to the kinds by their proportions, and envs to the columns in blocks of equal size; within a
    column, envs start at the levels 0 to `max_initial_level`, in turn. All randomness of the ground is of `seed` alone.

    Attributes:
        patches: the kinds of ground by name.
        num_levels: rows of the grid, from difficulty 0 to 1.
        num_columns: columns of the grid; columns of the same kind differ in their random numbers only.
        size: edge of a patch, m.
        max_initial_level: the highest level at which envs start.
        spawn_width: edge of the square about the centre in which envs start, level with its highest point, m.
        seed: of the ground.
        friction: sliding (1), torsional (m) and rolling (m) coefficients, as in MJCF.
    """

    patches: Mapping[str, TerrainPatch]
    num_levels: Count = 10
    num_columns: int = 10
    size: Positive = 8.0
    max_initial_level: WholeNumber = 5
    spawn_width: float = 1.4
    seed: WholeNumber = 0
    friction: Friction = (1.0, 0.005, 0.0001)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.patches:
            raise ValueError("patches={}: name at least one kind of ground")
        check_count("num_columns", self.num_columns, low=len(self.patches))
        check_in_range("spawn_width", self.spawn_width, low=0.0, high=self.size)

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        """The height field of the geom, and the bounds that follow from it."""
        return GEOM_FIELDS

    @property
    def columns(self) -> tuple[str, ...]:
        """The kind of each column."""
        shares = np.cumsum([patch.proportion for patch in self.patches.values()])
        names = tuple(self.patches)
        # Each kind gets one column, and the others go by the proportions.
        spare = self.num_columns - len(names)
        middles = (np.arange(spare) + 0.5) / max(spare, 1) * shares[-1]
        extra = np.bincount(np.searchsorted(shares, middles), minlength=len(names))
        return tuple(name for name, more in zip(names, extra, strict=True) for _ in range(1 + more))

    def difficulty(self, level: int) -> float:
        """Return the difficulty of a level, in [0, 1]; that of a single level is 1."""
        return level / (self.num_levels - 1) if self.num_levels > 1 else 1.0

    def heights(self, level: int, column: int) -> np.ndarray:
        """Return the heights of one patch, m, float64 [R, C]: rows along y, columns along x, lowest point 0."""
        patch = self.patches[self.columns[column]]
        rng = np.random.default_rng((self.seed, level, column))
        heights_RC = patch.heights(Lattice(self.size, patch.cell), self.difficulty(level), rng)
        return heights_RC - heights_RC.min()

    def spawn_height(self, heights_RC: np.ndarray) -> float:
        """Return the highest point of the cells of a patch that `spawn_width` reaches into, m."""
        lattice = Lattice(self.size, self.size / (len(heights_RC) - 1))
        return float(heights_RC[lattice.ring_RC < self.spawn_width / 2 + lattice.spacing - TIE].max())

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add all patches as height fields, and the geom, with the steepest patch in place."""
        add_look(spec, repeat=1)
        steepest, most = "", -math.inf
        for name, heights_RC in self._named():
            top = max(float(heights_RC.max()), THINNEST)
            rows, columns = heights_RC.shape
            half = self.size / 2
            spec.add_hfield(
                name=name,
                size=[half, half, top, BASE],
                nrow=rows,
                ncol=columns,
                userdata=(heights_RC / top).ravel().tolist(),
            )
            gradient = (columns - 1) * float(np.abs(np.diff(heights_RC)).mean())
            if gradient > most:
                steepest, most = name, gradient
        add_ground(
            spec,
            friction=self.friction,
            type=mujoco.mjtGeom.mjGEOM_HFIELD,
            hfieldname=steepest,
            mass=0,  # as planes have none
        )

    def ground(self, view: WorldView) -> PatchedGround:
        """Return the ground of the worlds of `view`, each on its first patch."""
        kinds = list(self.patches)
        return PatchedGround(
            view,
            num_levels=self.num_levels,
            max_initial_level=min(self.max_initial_level, self.num_levels - 1),
            kinds_of_columns=[kinds.index(kind) for kind in self.columns],
            spawn_heights=[self.spawn_height(heights_RC) for _, heights_RC in self._named()],
        )

    def _named(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield name and heights of each patch: all columns of level 0, then those of level 1, and so on."""
        for level in range(self.num_levels):
            for column in range(self.num_columns):
                yield patch_name(level, column), self.heights(level, column)
