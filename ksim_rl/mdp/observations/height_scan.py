"""A height scan looks up the shape of the ground around a robot in the terrain itself."""

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive, Range, Within
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.scene.sensors.ray_patterns import grid_points


@dataclass(frozen=True, kw_only=True)
class HeightScan(OfEntity, ObservationTerm):
    """How far the ground is below the root at the points of a grid, minus `offset`, clipped, m, [E, L]; position stage.

    The grid is centred on the root and turns with its yaw only. Points run along x (forward) first, from back to front,
    and these rows along y, from right to left. Heights are those of the terrain itself, exactly and without casting
    rays: of what else stands there nothing is seen (`scene.sensors` with a `RayCaster` does). Ground that is higher
    reads lower; on flat ground all points read root height - offset.

    Attributes:
        size: edges of the grid along x and y, m.
        resolution: m between neighbouring points.
        offset: m, about the root's height on flat ground, so that readings are around zero.
        clip: readings are clipped to this range, m.
    """

    size: Annotated[tuple[float, float], Within(low=0.0)] = (1.6, 1.0)
    resolution: Positive = 0.1
    offset: float = 0.5
    clip: Range = (-1.0, 1.0)

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        body = view.entity(self.entity)
        x_N, y_N = _grid(tuple(self.size), self.resolution, view.device)
        sin_E1, cos_E1 = torch.sin(body.heading_E)[:, None], torch.cos(body.heading_E)[:, None]
        root_E3 = body.root_pos_EL
        points_EN2 = root_E3[:, None, :2] + torch.stack(
            (cos_E1 * x_N - sin_E1 * y_N, sin_E1 * x_N + cos_E1 * y_N), dim=-1
        )
        below_EN = root_E3[:, 2:] - view.terrain.heights(points_EN2) - self.offset
        return below_EN.clamp(*self.clip)


@cache
def _grid(size: tuple[float, float], resolution: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return x and y of the points about the root, m, [N] each, on the device; made once."""
    x_N, y_N, _ = grid_points(size, resolution).T.tolist()
    return constant(x_N, device), constant(y_N, device)
