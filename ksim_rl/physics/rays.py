"""This module casts rays in all worlds at once."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.device.streams import warp_scope
from ksim_rl.physics.world import World

Groups = wp.types.vector(length=mujoco.mjNGROUP, dtype=wp.float32)


class RayBatch:
    """N rays per world, with their places in memory: write `start_EN3` and `direction_EN3`, then `cast`.

    Args:
        world: the worlds; `refresh` must have run since their state changed.
        num_rays: N.
        geom_groups: which of MuJoCo's geom groups rays hit.
        exclude_body: id of a body whose geoms no ray hits, or -1.

    Attributes:
        start_EN3, direction_EN3: where rays start, m, and their unit directions, world frame, float32 [E, N, 3].
        distance_EN: m to the first geom that is hit, -1 for none, float32 [E, N]; after `cast`.
        geom_EN: its id, -1 for none, int32 [E, N].
        normal_EN3: unit normal of its surface there, world frame, float32 [E, N, 3].
    """

    def __init__(
        self, world: World, num_rays: int, *, geom_groups: Sequence[int], exclude_body: int = -1
    ) -> None:
        self._world = world
        # All -1 would mean every group, so groups are switched one by one.
        self._groups = Groups(*[float(group in geom_groups) for group in range(mujoco.mjNGROUP)])
        shape = (world.num_envs, num_rays)
        with warp_scope(world.device):
            self._start, self._direction, self._normal = (wp.zeros(shape, dtype=wp.vec3) for _ in range(3))
            self._distance, self._geom = wp.zeros(shape, dtype=float), wp.zeros(shape, dtype=int)
            self._exclude = wp.array(np.full(num_rays, exclude_body, dtype=np.int32), dtype=int)
        self.start_EN3, self.direction_EN3 = wp.to_torch(self._start), wp.to_torch(self._direction)
        self.distance_EN, self.geom_EN = wp.to_torch(self._distance), wp.to_torch(self._geom)
        self.normal_EN3 = wp.to_torch(self._normal)

    def cast(self) -> None:
        """Cast all rays against the present poses of the geoms."""
        self._world.launch(self, self._launch)

    def _launch(self) -> None:
        mjw.rays(
            self._world.warp_model,
            self._world.warp_data_E,
            self._start,
            self._direction,
            self._groups,
            True,
            self._exclude,
            self._distance,
            self._geom,
            self._normal,
        )
