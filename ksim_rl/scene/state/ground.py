"""The ground of E worlds as terms read it: where envs start, and how high it is at any place."""

import math

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ksim_rl.scene.near_names import NearNames


class Ground(NearNames):
    """Flat ground at z = 0, without end. Terrains that differ between worlds refine it.

    Attributes:
        is_flat: whether all heights and origins are zero.
        half_width: from a world's origin to the edge of its ground, along x and y, m; there is nothing beyond it.
        num_levels: how many levels of difficulty there are.
    """

    is_flat: bool = True
    half_width: float = math.inf
    num_levels: int = 1

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self._origins_E3 = torch.zeros(num_envs, 3, device=device)
        self._zeros_E = torch.zeros(num_envs, dtype=torch.int64, device=device)

    @property
    def origins_E3(self) -> Float[Tensor, "E 3"]:
        """Where each env starts: a point on the ground, m, world frame."""
        return self._origins_E3

    @property
    def levels_E(self) -> Int64[Tensor, " E"]:
        """The level of difficulty of each env, in [0, num_levels)."""
        return self._zeros_E

    def heights(self, points_EN2: Float[Tensor, "E N 2"]) -> Float[Tensor, "E N"]:
        """Return the height of the ground at x, y (world frame, m), m; beyond the edge, of the nearest point."""
        return torch.zeros_like(points_EN2[..., 0])

    def clearance(self, points_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E N"]:
        """Return how high points (world frame, m) are above the ground right below them, m."""
        height_EN = points_EN3[..., 2]
        # Flat ground needs no look-up: height above it is z.
        if self.is_flat:
            return height_EN
        return height_EN - self.heights(points_EN3[..., :2])

    def places_on_even_ground(
        self, *, edge: float, max_difference: float, count: int
    ) -> Float[Tensor, "E count 3"]:
        """Return places of each env's ground, m, world frame, in the middle of even squares; see `PatchedGround`.

        Raises ValueError where the ground has no such, and for ground without patches.
        """
        raise ValueError(
            "the scene's terrain is even everywhere: use ResetRootUniform, or a TerrainGrid in scene.terrain"
        )

    def set_levels(self, mask_E: Bool[Tensor, " E"], levels_E: Int64[Tensor, " E"]) -> None:
        """Move the rows of `mask_E` to other levels, before their reset; a ValueError where the terrain has none."""
        raise ValueError("the scene's terrain has no levels: use a TerrainGrid in scene.terrain")
