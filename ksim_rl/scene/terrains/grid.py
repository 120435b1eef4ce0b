"""Lays ground out in levels of difficulty and columns of kinds; each world has one patch to itself."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.checked import Count, Filled, Positive, Seed, WholeNumber
from ksim_rl.checks import check_count, check_in_range
from ksim_rl.physics.model_size import check_size
from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.state.world_view import WorldView
from ksim_rl.scene.terrains.patch import TIE, Lattice, TerrainPatch
from ksim_rl.scene.terrains.terrain import BODY, Friction, Terrain, add_ground, add_look

BASE = 0.5
"""m of solid ground below the lowest point of a patch."""
THINNEST = 1e-3
"""m between the lowest and the highest point of a patch, at least: MuJoCo wants height fields with some height."""


GEOM_FIELDS = ("geom_dataid", "geom_size", "geom_aabb", "geom_rbound")
"""The model fields of the terrain's geom that say which height field it is, and the bounds that follow from that."""


def patch_name(level: int, column: int) -> str:
    """Return the name of a patch's height field."""
    return f"{BODY}_{level}_{column}"


@dataclass(frozen=True, kw_only=True)
class TerrainGrid(Terrain):
    """`num_levels` x `num_columns` square patches of ground.

    Each world collides with one patch, which lies about that world's origin: the height field of the geom "terrain" is
    chosen per world (`geom_dataid`), so that physics costs what one small patch costs, however many there are. The
    lowest point of a patch is at z = 0. Beyond its edge there is nothing: end episodes there (`mdp.OutsideTerrain`).

    Columns are dealt to the kinds by their proportions, and envs to the columns in blocks of equal size; within a
    column, envs start at the levels 0 to `max_initial_level`, in turn. All randomness of the ground is of `seed` alone.

    Attributes:
        num_levels, num_columns: rows, from difficulty 0 to 1; columns of one kind differ in their random numbers only.
        size: edge of a patch, m.
        spawn_width: edge of the square about the centre in which envs start, level with its highest point, m.
    """

    patches: Annotated[Mapping[str, TerrainPatch], Filled("name at least one kind of ground")]
    num_levels: Count = 10
    num_columns: int = 10
    size: Positive = 8.0
    max_initial_level: WholeNumber = 5
    spawn_width: float = 1.4
    seed: Seed = 0
    friction: Friction = (1.0, 0.005, 0.0001)

    def _check_fields(self) -> None:
        super()._check_fields()
        check_count("num_columns", self.num_columns, low=len(self.patches))
        # Before the height of each point is worked out.
        finest = min(patch.cell for patch in self.patches.values())
        patches = self.num_levels * self.num_columns
        check_size(
            elements=patches,
            numbers=patches * math.ceil((self.size / finest) ** 2),
            label=f"num_levels={self.num_levels}, num_columns={self.num_columns}, size={self.size}, cell={finest}",
        )
        check_in_range("spawn_width", self.spawn_width, low=0.0, high=self.size)

    @property
    def per_world_fields(self) -> tuple[str, ...]:
        return GEOM_FIELDS

    @property
    def columns(self) -> tuple[str, ...]:
        """The kind of each column."""
        # The end of each kind's share on a line from 0 to the sum of all.
        shares = np.cumsum([patch.proportion for patch in self.patches.values()])
        names = tuple(self.patches)
        # Each kind gets one column, and the others go by the proportions.
        spare = self.num_columns - len(names)
        # Evenly spaced points on that line; each falls into the share of one kind.
        middles = (np.arange(spare) + 0.5) / max(spare, 1) * shares[-1]
        extra = np.bincount(np.searchsorted(shares, middles), minlength=len(names))
        return tuple(name for name, more in zip(names, extra, strict=True) for _ in range(1 + more))

    def difficulty(self, level: int) -> float:
        """Return the difficulty of a level, in [0, 1]; a single level has 1."""
        if self.num_levels > 1:
            return level / (self.num_levels - 1)
        return 1.0

    def heights(self, level: int, column: int) -> np.ndarray:
        """Return the heights of one patch, m, float64 [R, C]: rows along y, columns along x, lowest point 0."""
        patch = self.patches[self.columns[column]]
        # Seeded by level and column, so that a patch does not depend on how many others there are.
        rng = np.random.default_rng((self.seed, level, column))
        heights_RC = patch.heights(Lattice(self.size, patch.cell), self.difficulty(level), rng)
        # MuJoCo's height fields start at 0.
        return heights_RC - heights_RC.min()

    def spawn_height(self, heights_RC: np.ndarray) -> float:
        """Return the highest point of the cells of a patch that `spawn_width` reaches into, m."""
        lattice = Lattice(self.size, self.size / (len(heights_RC) - 1))
        # One more point beyond the square: the ground is a triangle up to there.
        return float(
            heights_RC[lattice.ring_RC < self.spawn_width / 2 + lattice.spacing - TIE].max()
        )

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add all patches as height fields, and the geom, with the steepest patch in place."""
        # One pattern per metre.
        add_look(spec, repeat=1)
        steepest = ""
        most = -math.inf
        for name, heights_RC in self.named_heights():
            # MuJoCo keeps heights as shares of the top, in [0, 1].
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
            # Mean step between neighbours, by cells per edge: a slope in the same unit for all patches.
            gradient = (columns - 1) * float(np.abs(np.diff(heights_RC)).mean())
            # The compiled model alone shows the hardest patch.
            if gradient > most:
                steepest = name
                most = gradient
        add_ground(
            spec,
            friction=self.friction,
            type=mujoco.mjtGeom.mjGEOM_HFIELD,
            hfieldname=steepest,
            mass=0,  # as planes have none
        )

    def ground(self, view: WorldView) -> "PatchedGround":
        return PatchedGround(view, self)

    def named_heights(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield the name of each patch's height field and its heights: all columns of level 0, then level 1, ..."""
        for level in range(self.num_levels):
            for column in range(self.num_columns):
                yield patch_name(level, column), self.heights(level, column)


class PatchedGround(Ground):
    """Keeps which height field each world collides with, and looks heights up in them.

    P patches are consecutive height fields of the model, level by level: patch = level * num_columns + column.
    """

    is_flat = False

    def __init__(self, view: WorldView, grid: TerrainGrid) -> None:
        super().__init__(view.num_envs, view.device)
        self._grid = grid
        # Tables of even places, by their settings; made while the env is constructed.
        self._even: dict[tuple[float, float, int], Tensor] = {}
        mj_model = view.world.mj_model
        device = view.device
        self.num_levels = grid.num_levels
        self._num_columns = grid.num_columns
        # A grid may have fewer levels than envs are asked to start at.
        max_initial_level = min(grid.max_initial_level, grid.num_levels - 1)
        spawn_heights = [grid.spawn_height(heights_RC) for _, heights_RC in grid.named_heights()]
        # A robot's own model may have height fields too.
        first = int(mj_model.hfield(patch_name(0, 0)).id)
        # The patches' height fields are consecutive, since they were added in one loop.
        patches = slice(first, first + len(spawn_heights))
        self.half_width = float(mj_model.hfield_size[first, 0])
        self._geom = int(mj_model.geom(BODY).id)
        # One row per world: writing it moves a world to another patch.
        self._fields = {name: view.world.field(name) for name in GEOM_FIELDS}
        self._of_patch = {
            name: torch.tensor(value[patches], device=device)
            for name, value in _geom_fields(mj_model).items()
        }
        # The top of each number's own height field.
        tops = np.repeat(mj_model.hfield_size[:, 2], mj_model.hfield_nrow * mj_model.hfield_ncol)
        self._heights = torch.tensor(
            mj_model.hfield_data * tops, dtype=torch.float32, device=device
        )
        self._address_P = torch.tensor(
            mj_model.hfield_adr[patches], dtype=torch.int64, device=device
        )
        self._columns_P = torch.tensor(
            mj_model.hfield_ncol[patches], dtype=torch.int64, device=device
        )
        self._spawn_heights_P = torch.tensor(spawn_heights, dtype=torch.float32, device=device)

        # By an env's place among the envs of all ranks.
        place_E = torch.arange(view.num_envs, device=device) + ranks.first_row(view.num_envs)
        num_places = view.num_envs * ranks.size()
        # Blocks of envs by column; the first place of a block is rounded up.
        self._column_E = place_E * self._num_columns // num_places
        first_E = -(-self._column_E * num_places // self._num_columns)
        self._first_level_E = (place_E - first_E) % (max_initial_level + 1)
        # Buffers start at zero, so that the kept number is how far each env has moved.
        self._moved_E = view.buffers.get("terrain.moved_E", dtype=torch.int64, keep=True)
        # All worlds start with the steepest patch in place.
        self._place(torch.ones(view.num_envs, dtype=torch.bool, device=device))

    @property
    def levels_E(self) -> Int64[Tensor, " E"]:
        return self._first_level_E + self._moved_E

    @property
    def patches_E(self) -> Int64[Tensor, " E"]:
        """The height field that each env stands on."""
        return self.levels_E * self._num_columns + self._column_E

    @property
    def origins_E3(self) -> Float[Tensor, "E 3"]:
        """Where each env starts: (0, 0) at the height of the highest point around, world frame, m."""
        height_E = self._spawn_heights_P[self.patches_E]
        # Patches lie about each world's own origin, so x and y are 0.
        return torch.stack(
            (torch.zeros_like(height_E), torch.zeros_like(height_E), height_E), dim=-1
        )

    def heights(self, points_EN2: Float[Tensor, "E N 2"]) -> Float[Tensor, "E N"]:
        """Return the height of the ground at x, y, exact on its triangles; beyond the edge, of the nearest one."""
        patch_E = self.patches_E
        columns_E1 = self._columns_P[patch_E][:, None]
        cells_E11 = (columns_E1 - 1)[..., None]
        # From metres in [-half_width, half_width] to cells in [0, columns - 1].
        place_EN2 = (points_EN2 / self.half_width + 1.0) * (0.5 * cells_E11)
        # The clamp gives points beyond the edge the height of the nearest edge.
        place_EN2 = torch.minimum(place_EN2.clamp(min=0.0), cells_E11)
        # The last point belongs to the last cell.
        corner_EN2 = torch.minimum(place_EN2.long(), cells_E11 - 1)
        within_EN2 = place_EN2 - corner_EN2
        x_EN = within_EN2[..., 0]
        y_EN = within_EN2[..., 1]
        # Rows run along y, columns along x.
        first_EN = (
            self._address_P[patch_E][:, None] + corner_EN2[..., 1] * columns_E1 + corner_EN2[..., 0]
        )
        # MuJoCo splits each cell along the diagonal from its first corner to the opposite one.
        second_EN = first_EN + torch.where(x_EN >= y_EN, 1, columns_E1)
        # Corners of the triangle: first, the one along the longer step, and the opposite one.
        low_EN, mid_EN, high_EN = (
            self._heights[index] for index in (first_EN, second_EN, first_EN + columns_E1 + 1)
        )
        # Barycentric: along the greater coordinate first, then along the smaller one.
        steep_EN = torch.maximum(x_EN, y_EN)
        flat_EN = torch.minimum(x_EN, y_EN)
        return low_EN + steep_EN * (mid_EN - low_EN) + flat_EN * (high_EN - mid_EN)

    def places_on_even_ground(
        self, *, edge: float, max_difference: float, count: int
    ) -> Float[Tensor, "E count 3"]:
        """Return places of each env's patch, m, world frame, around which a square is even; z is its highest point.

        Heights within a square of the given edge, m, differ by `max_difference` at most. The places are drawn from all
        points of the patch's lattice that are so, by the seed of the terrain. A ValueError names a patch without any.
        """
        key = (edge, max_difference, count)
        if key not in self._even:
            tables = [
                self._even_places(level, column, *key)
                for level in range(self.num_levels)
                for column in range(self._num_columns)
            ]
            self._even[key] = torch.tensor(
                np.stack(tables), dtype=torch.float32, device=self._heights.device
            )
        return self._even[key][self.patches_E]

    def _even_places(
        self, level: int, column: int, edge: float, max_difference: float, count: int
    ) -> np.ndarray:
        """Return the places of one patch, float64 [count, 3]."""
        grid = self._grid
        heights_RC = grid.heights(level, column)
        lattice = Lattice(grid.size, grid.size / (len(heights_RC) - 1))
        # All points of the cells that the square reaches into.
        reach = math.ceil(edge / 2 / lattice.spacing - TIE)
        width = 2 * reach + 1
        if width > len(heights_RC):
            raise ValueError(f"edge={edge}: the patches of the terrain have edges of {grid.size} m")
        windows = np.lib.stride_tricks.sliding_window_view(heights_RC, (width, width))
        highest_RC = windows.max((-2, -1))
        is_even_RC = highest_RC - windows.min((-2, -1)) <= max_difference
        row_N, column_N = np.nonzero(is_even_RC)
        if not len(row_N):
            raise ValueError(
                f"no square of {edge} m of level {level} of the ground {grid.columns[column]!r} is even within "
                f"max_difference={max_difference}: ask for a smaller edge, or allow more"
            )
        chosen = np.random.default_rng((grid.seed, level, column, count)).integers(
            0, len(row_N), count
        )
        row_N = row_N[chosen]
        column_N = column_N[chosen]
        # A window begins `reach` points before its middle.
        x_N = lattice.x_RC[0, column_N + reach]
        y_N = lattice.y_RC[row_N + reach, 0]
        return np.stack((x_N, y_N, highest_RC[row_N, column_N]), axis=-1)

    def set_levels(self, mask_E: Bool[Tensor, " E"], levels_E: Int64[Tensor, " E"]) -> None:
        moved_E = levels_E - self._first_level_E
        self._moved_E.copy_(torch.where(mask_E, moved_E, self._moved_E))
        self._place(mask_E)

    def _place(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Write the model fields of the patches into the rows of `mask_E`."""
        patch_E = self.patches_E
        for name, field in self._fields.items():
            # The terrain's geom in all worlds: a view, so that writing it writes the field.
            row = field[:, self._geom]
            mask = mask_E.view(-1, *[1] * (row.ndim - 1))
            # The engines lay a box out in two rows of three numbers, or in one of six.
            of_patch = self._of_patch[name][patch_E].reshape(row.shape)
            row.copy_(torch.where(mask, of_patch, row))


def _geom_fields(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the values of `GEOM_FIELDS` that MuJoCo's compiler gives a geom of each height field, by name."""
    # In float32, as the engines keep model fields.
    half_x, half_y, top, base = mj_model.hfield_size.astype(np.float32).T
    nothing_P = np.zeros_like(top)
    centre_P3 = np.stack((nothing_P, nothing_P, (top - base) / 2), axis=-1)
    half_P3 = np.stack((half_x, half_y, (top + base) / 2), axis=-1)
    return {
        "geom_dataid": np.arange(mj_model.nhfield, dtype=np.int32),
        "geom_size": np.stack((half_x, half_y, 0.25 * top + 0.5 * base), axis=-1),
        "geom_aabb": np.stack((centre_P3, half_P3), axis=1),
        "geom_rbound": np.sqrt(half_x**2 + half_y**2 + np.maximum(top, base) ** 2),
    }
