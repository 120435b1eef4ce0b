"""This module casts rays from a place on a robot, and says how far it is to whatever they hit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.physics.ray_casting import RayBatch
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors.mount import MountedSensor
from ksim_rl.scene.sensors.ray_patterns import RayPattern
from ksim_rl.scene.sensors.sensor import GeomGroup, SensorTracker
from ksim_rl.scene.small_matrices import product
from ksim_rl.scene.state.world_view import WorldView


class RayState(NamedTuple):
    """What N rays hit first, float32 unless stated otherwise; position stage."""

    distance_EN: Float[Tensor, "E N"]
    """m from where the ray starts, [E, N]; `max_distance` where nothing is hit within it."""
    hit_EN: Bool[Tensor, "E N"]
    """Whether something is hit within `max_distance`, bool [E, N]."""
    point_EN3: Float[Tensor, "E N 3"]
    """The end of the ray, world frame, m, [E, N, 3]."""
    normal_EN3: Float[Tensor, "E N 3"]
    """Unit normal of the surface that is hit, world frame, [E, N, 3]; zero where there is none."""


@dataclass(frozen=True, kw_only=True)
class RayCaster(MountedSensor):
    """Rays against all geoms of some groups.

    They hit whatever is there, moving things too, and cost accordingly: for the shape of the terrain alone,
    `mdp.HeightScan` is much cheaper.

    Attributes:
        pattern: the rays in the sensor's axes.
        alignment: how the pattern turns: with the "site", with its "yaw" only, or not at all ("world").
        max_distance: m.
        geom_groups: which of MuJoCo's geom groups are hit; 2 are by custom robots' visual, 3 their collision geoms.
        exclude_body: rays do not hit geoms of the body that carries the sensor.
    """

    pattern: RayPattern
    alignment: Literal["site", "yaw", "world"] = "site"
    max_distance: Positive = 10.0
    geom_groups: tuple[GeomGroup, ...] = (0, 1)
    exclude_body: bool = True

    def track(self, name: str, view: WorldView) -> RayTracker:
        """Return the reader of this sensor in the worlds of `view`."""
        return RayTracker(name, self, view)


class RayTracker(SensorTracker):
    """Casts the rays of one sensor, at most once per state, and only if something reads them."""

    def __init__(self, name: str, sensor: RayCaster, view: WorldView) -> None:
        self._sensor, self._view, self._key = sensor, view, f"rays/{name}."
        site = view.world.mj_model.site(sensor.mounting_site(name))
        self._site = int(site.id)
        start_N3, direction_N3 = (
            torch.tensor(table, dtype=torch.float32, device=view.device) for table in sensor.pattern.rays()
        )
        self._start_N3, self._direction_N3 = start_N3, direction_N3
        self._batch = RayBatch(
            view.world,
            len(start_N3),
            geom_groups=sensor.geom_groups,
            exclude_body=int(site.bodyid[0]) if sensor.exclude_body else -1,
        )

    @property
    def state(self) -> RayState:
        """What the rays hit in the current state."""
        cache = self._view.cache
        if self._key + RayState._fields[0] not in cache:
            cache.update({self._key + name: value for name, value in self._cast()._asdict().items()})
        return RayState(*(cache[self._key + name] for name in RayState._fields))

    @property
    def origin_E3(self) -> Float[Tensor, "E 3"]:
        """Place of the sensor, world frame, m, [E, 3]."""
        return self._view.derived().site_xpos_EL[:, self._site]

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw a ball where each ray hits."""
        state = self.state
        points = state.point_EN3[env_index].cpu().numpy()
        for point, is_hit in zip(points, state.hit_EN[env_index].tolist(), strict=True):
            if is_hit:
                visualizer.sphere(point, radius=0.015, rgba=(0.9, 0.2, 0.2, 1.0))

    def _cast(self) -> RayState:
        """Cast, and copy what was found: the next cast overwrites it."""
        batch, most = self._batch, self._sensor.max_distance
        batch.start_EN3.copy_(self.origin_E3[:, None] + self._turned(self._start_N3))
        batch.direction_EN3.copy_(self._turned(self._direction_N3))
        batch.cast()
        hit_EN = (batch.distance_EN >= 0.0) & (batch.distance_EN <= most)
        distance_EN = torch.where(hit_EN, batch.distance_EN, most)
        return RayState(
            distance_EN=distance_EN,
            hit_EN=hit_EN,
            point_EN3=batch.start_EN3 + distance_EN[..., None] * batch.direction_EN3,
            normal_EN3=torch.where(hit_EN[..., None], batch.normal_EN3, 0.0),
        )

    def _turned(self, vectors_N3: Float[Tensor, "N 3"]) -> Tensor:
        """Turn vectors from the sensor's axes to the world's, [E, N, 3]."""
        if self._sensor.alignment == "world":
            return vectors_N3.expand(self._view.num_envs, -1, -1)
        matrix_E33 = self._view.derived().site_xmat_EL[:, self._site].view(-1, 3, 3)
        if self._sensor.alignment == "yaw":
            yaw_E1 = torch.atan2(matrix_E33[:, 1, 0], matrix_E33[:, 0, 0])[:, None]
            cos_E1, sin_E1 = torch.cos(yaw_E1), torch.sin(yaw_E1)
            x_N, y_N, z_N = vectors_N3.unbind(-1)
            turned = (cos_E1 * x_N - sin_E1 * y_N, sin_E1 * x_N + cos_E1 * y_N, z_N.expand(len(cos_E1), -1))
            return torch.stack(turned, dim=-1)
        return product(vectors_N3, matrix_E33.mT)
