"""This module has the ground of worlds that each stand on one of many height fields."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ksim_rl.scene.state.ground import Ground
from ksim_rl.scene.state.world_view import WorldView
from ksim_rl.scene.terrains.terrain import BODY

GEOM_FIELDS = ("geom_dataid", "geom_size", "geom_aabb", "geom_rbound")
"""The model fields of the terrain's geom that say which height field it is, and the bounds that follow from that."""


def patch_name(level: int, column: int) -> str:
    """Return the name of a patch's height field."""
    return f"{BODY}_{level}_{column}"


class PatchedGround(Ground):
    """Keeps which height field each world collides with, and looks heights up in them.

    P patches are consecutive height fields of the model, level by level: patch = level * num_columns + column.
    """

    is_flat = False

    def __init__(
        self,
        view: WorldView,
        *,
        num_levels: int,
        max_initial_level: int,
        kinds_of_columns: Sequence[int],
        spawn_heights: Sequence[float],
    ) -> None:
        super().__init__(view.num_envs, view.device)
        mj_model, device = view.world.mj_model, view.device
        self.num_levels, self._num_columns = num_levels, len(kinds_of_columns)
        # A robot's own model may have height fields too.
        first = int(mj_model.hfield(patch_name(0, 0)).id)
        patches = slice(first, first + len(spawn_heights))
        self.half_width = float(mj_model.hfield_size[first, 0])
        self._geom = int(mj_model.geom(BODY).id)
        self._fields = {name: view.world.field(name) for name in GEOM_FIELDS}
        self._of_patch = {
            name: torch.tensor(value[patches], device=device)
            for name, value in _geom_fields(mj_model).items()
        }
        tops = np.repeat(mj_model.hfield_size[:, 2], mj_model.hfield_nrow * mj_model.hfield_ncol)
        self._heights = torch.tensor(mj_model.hfield_data * tops, dtype=torch.float32, device=device)
        self._address_P = torch.tensor(mj_model.hfield_adr[patches], dtype=torch.int64, device=device)
        self._columns_P = torch.tensor(mj_model.hfield_ncol[patches], dtype=torch.int64, device=device)
        self._spawn_heights_P = torch.tensor(spawn_heights, dtype=torch.float32, device=device)

        place_E = torch.arange(view.num_envs, device=device)
        self._column_E = place_E * self._num_columns // view.num_envs
        first_E = torch.searchsorted(self._column_E, self._column_E)
        self._first_level_E = (place_E - first_E) % (max_initial_level + 1)
        self._types_E = torch.tensor(kinds_of_columns, device=device)[self._column_E]
        # Memories start at zero, so what is kept is how far each env has moved.
        self._moved_E = view.buffers.get("terrain.moved_E", dtype=torch.int64, keep=True)
        self._place(torch.ones(view.num_envs, dtype=torch.bool, device=device))

    @property
    def levels_E(self) -> Int64[Tensor, " E"]:
        """The level of difficulty of each env, int64 [E] in [0, num_levels)."""
        return self._first_level_E + self._moved_E

    @property
    def types_E(self) -> Int64[Tensor, " E"]:
        """The kind of ground of each env, as an index into `TerrainGrid.patches`, int64 [E]; it never changes."""
        return self._types_E

    @property
    def patches_E(self) -> Int64[Tensor, " E"]:
        """The height field that each env stands on, int64 [E]."""
        return self.levels_E * self._num_columns + self._column_E

    @property
    def origins_E3(self) -> Float[Tensor, "E 3"]:
        """Where each env starts: (0, 0) at the height of the highest point around, world frame, m, [E, 3]."""
        height_E = self._spawn_heights_P[self.patches_E]
        return torch.stack((torch.zeros_like(height_E), torch.zeros_like(height_E), height_E), dim=-1)

    def heights(self, points_EN2: Float[Tensor, "E N 2"]) -> Float[Tensor, "E N"]:
        """Return the height of the ground at x, y (world frame, m, [E, N, 2]), m, [E, N], exact on its triangles.

        Beyond the edge it is that of the nearest point within.
        """
        patch_E = self.patches_E
        columns_E1 = self._columns_P[patch_E][:, None]
        cells_E11 = (columns_E1 - 1)[..., None]
        place_EN2 = (points_EN2 / self.half_width + 1.0) * (0.5 * cells_E11)
        place_EN2 = torch.minimum(place_EN2.clamp(min=0.0), cells_E11)
        corner_EN2 = torch.minimum(place_EN2.long(), cells_E11 - 1)
        within_EN2 = place_EN2 - corner_EN2
        x_EN, y_EN = within_EN2[..., 0], within_EN2[..., 1]
        first_EN = self._address_P[patch_E][:, None] + corner_EN2[..., 1] * columns_E1 + corner_EN2[..., 0]
        # MuJoCo splits each cell along the diagonal from its first corner to the opposite one.
        second_EN = first_EN + torch.where(x_EN >= y_EN, 1, columns_E1)
        low_EN, mid_EN, high_EN = (
            self._heights[index] for index in (first_EN, second_EN, first_EN + columns_E1 + 1)
        )
        steep_EN, flat_EN = torch.maximum(x_EN, y_EN), torch.minimum(x_EN, y_EN)
        return low_EN + steep_EN * (mid_EN - low_EN) + flat_EN * (high_EN - mid_EN)

    def set_levels(self, mask_E: Bool[Tensor, " E"], levels_E: Int64[Tensor, " E"]) -> None:
        """Move the rows of `mask_E` (bool [E]) to other levels (int64 [E]), before their reset."""
        self._moved_E.copy_(torch.where(mask_E, levels_E - self._first_level_E, self._moved_E))
        self._place(mask_E)

    def _place(self, mask_E: Bool[Tensor, " E"]) -> None:
        """Write the model fields of the patches into the rows of `mask_E`."""
        patch_E = self.patches_E
        for name, field in self._fields.items():
            row = field[:, self._geom]
            mask = mask_E.view(-1, *[1] * (row.ndim - 1))
            row.copy_(torch.where(mask, self._of_patch[name][patch_E], row))


def _geom_fields(mj_model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the values of `GEOM_FIELDS` for a geom of each height field of the model, by name, [P, ...].

    They are those that MuJoCo's compiler gives a geom of this height field.
    """
    half_x, half_y, top, base = mj_model.hfield_size.astype(np.float32).T
    centre_P3 = np.stack((np.zeros_like(top), np.zeros_like(top), (top - base) / 2), axis=-1)
    half_P3 = np.stack((half_x, half_y, (top + base) / 2), axis=-1)
    return {
        "geom_dataid": np.arange(mj_model.nhfield, dtype=np.int32),
        "geom_size": np.stack((half_x, half_y, 0.25 * top + 0.5 * base), axis=-1),
        "geom_aabb": np.stack((centre_P3, half_P3), axis=1),
        "geom_rbound": np.sqrt(half_x**2 + half_y**2 + np.maximum(top, base) ** 2),
    }
