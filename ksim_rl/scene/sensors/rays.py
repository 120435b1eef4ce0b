"""Casts rays from a place on a robot, in patterns, and measures the distance to whatever they hit.

Patterns are in the sensor's own axes: x forward, y left, z up.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Checked, Count, Filled, Positive, Within
from ksim_rl.checks import naming
from ksim_rl.physics.ray_casting import RayBatch
from ksim_rl.scene.names import match_names
from ksim_rl.scene.near_names import NearNames
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors.sensor import GeomGroup, MountedSensor, SensorTracker
from ksim_rl.scene.small_matrices import product
from ksim_rl.scene.state.world_view import WorldView


@dataclass(frozen=True, kw_only=True)
class RayPattern(Checked, ABC):
    """A bundle of N rays."""

    @abstractmethod
    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return where the rays start, m, and their unit directions, float64 [N, 3] each, in the sensor's axes."""


@dataclass(frozen=True, kw_only=True)
class GridPattern(RayPattern):
    """Parallel rays that start at the points of a grid, parallel to the sensor's xy plane and `height` (m) above it.

    Points run along x (forward) first, from back to front, and these rows along y, from right to left; `size` are the
    edges along x and y, and `resolution` is the distance of neighbours, m. Rays that start low miss higher geoms.
    """

    size: Annotated[tuple[float, float], Within(low=0.0)] = (1.6, 1.0)
    resolution: Positive = 0.1
    height: float = 0.0
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)

    def _check_fields(self) -> None:
        super()._check_fields()
        # A direction of zero cannot be normalized.
        if not any(self.direction):
            raise ValueError(f"direction={self.direction!r}: expected a vector that is not zero")

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        start_N3 = grid_points(self.size, self.resolution) + np.array([0.0, 0.0, self.height])
        # All rays are parallel.
        direction = np.asarray(self.direction) / np.linalg.norm(self.direction)
        return start_N3, np.broadcast_to(direction, start_N3.shape)

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the distances that all rays measure."""
        return {
            ("size", "resolution"): num_envs
            * math.prod(edge / self.resolution for edge in self.size)
        }


@dataclass(frozen=True, kw_only=True)
class PinholePattern(RayPattern):
    """The rays of a camera that looks along x: one through the middle of each pixel, row by row from the top left.

    `fovy` is the vertical field of view, degrees; pixels are square.
    """

    width: Count = 16
    height: Count = 12
    fovy: Annotated[float, Within(low=0.0, high=179.0, low_open=True)] = 60.0

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the distances that all rays measure."""
        return {("width", "height"): num_envs * self.width * self.height}

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        # The edge of a pixel at a distance of 1.
        pixel = 2.0 * math.tan(math.radians(self.fovy) / 2) / self.height
        # Middles of pixels; y is to the left, z upwards.
        left = ((self.width - 1) / 2 - np.arange(self.width)) * pixel
        up = ((self.height - 1) / 2 - np.arange(self.height)) * pixel
        up_N, left_N = (table.ravel() for table in np.meshgrid(up, left, indexing="ij"))
        # The plane of the picture lies at x = 1.
        return _from_origin(np.stack((np.ones_like(left_N), left_N, up_N), axis=-1))


Elevation = Annotated[float, Within(low=-90.0, high=90.0)]


@dataclass(frozen=True, kw_only=True)
class RingPattern(RayPattern):
    """The rays of a turning lidar: rings about z, one after the other, each from +x to the left all around.

    Each ring has `num_rays`, and one of the `elevations`, degrees above the xy plane.
    """

    num_rays: Count = 36
    elevations: Annotated[
        tuple[Elevation, ...], Filled("give at least one ring, such as (0.0,)")
    ] = (0.0,)

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the distances that all rays measure."""
        return {("num_rays",): num_envs * self.num_rays}

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        # Without 2 pi itself, which is the direction of 0.
        around = 2 * np.pi * np.arange(self.num_rays) / self.num_rays
        tables = np.meshgrid(np.radians(self.elevations), around, indexing="ij")
        up_N, around_N = (table.ravel() for table in tables)
        # A higher ring has a smaller circle.
        flat_N = np.cos(up_N)
        x_N = flat_N * np.cos(around_N)
        y_N = flat_N * np.sin(around_N)
        return _from_origin(np.stack((x_N, y_N, np.sin(up_N)), axis=-1))


def grid_points(size: tuple[float, float], resolution: float) -> np.ndarray:
    """Return the points of a grid about the origin, m, [N, 3]: rows along x, one after the other along y; z is 0."""
    along_x, along_y = (
        # Centred: as many points on both sides.
        (np.arange(count + 1) - count / 2) * resolution
        # A tiny bit more, so that 1.6 / 0.1 counts 16 cells.
        for count in (math.floor(edge / resolution + 1e-6) for edge in size)
    )
    # "ij" with y first: x runs fastest.
    y_N, x_N = (table.ravel() for table in np.meshgrid(along_y, along_x, indexing="ij"))
    return np.stack((x_N, y_N, np.zeros_like(x_N)), axis=-1)


def _from_origin(direction_N3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    unit_N3 = direction_N3 / np.linalg.norm(direction_N3, axis=-1, keepdims=True)
    return np.zeros_like(unit_N3), unit_N3


class RayState(NamedTuple):
    """The first hits of N rays, float32 unless stated otherwise; position stage."""

    distance_EN: Float[Tensor, "E N"]
    """Distance from where the ray starts, m, [E, N]; `max_distance` where nothing is hit within it."""
    hit_EN: Bool[Tensor, "E N"]
    """Whether something is hit within `max_distance`, bool [E, N]."""
    point_EN3: Float[Tensor, "E N 3"]
    """The end of the ray, m, world frame, [E, N, 3]."""
    normal_EN3: Float[Tensor, "E N 3"]
    """Unit normal of the surface that is hit, world frame, [E, N, 3]; zero where there is none."""

    # A named tuple takes no second base.
    if not TYPE_CHECKING:
        __getattr__ = NearNames.__getattr__


@dataclass(frozen=True, kw_only=True)
class RayCaster(MountedSensor):
    """Rays against all geoms of some groups (2 are by custom robots' visual geoms, 3 their collision geoms).

    They hit whatever is there within `max_distance` (m), moving things too, and cost accordingly: for the shape of the
    terrain alone, `mdp.HeightScan` is much cheaper. The pattern turns with the "site", with its "yaw" only, or not at
    all ("world"); `exclude_body` leaves out geoms of the body that carries the sensor. `sites` in place of `site` or
    `body` cast the pattern from each site that they match, one after the other: N is the number of all rays.
    """

    pattern: RayPattern
    sites: tuple[str, ...] = ()
    alignment: Literal["site", "yaw", "world"] = "site"
    max_distance: Positive = 10.0
    geom_groups: tuple[GeomGroup, ...] = (0, 1)
    exclude_body: bool = True

    def _check_mount(self) -> None:
        if not self.sites:
            super()._check_mount()
            return
        if self.site is not None or self.body is not None or any(self.pos):
            raise ValueError(
                f"sites={self.sites!r} with site={self.site!r}, body={self.body!r}, pos={self.pos!r}: "
                "give the sites alone"
            )

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        if not self.sites:
            super().add_to(spec, name)
            return
        with naming(f"scene.sensors.{name}"):
            match_names("site", self.sites, [site.name for site in spec.sites])

    def track(self, name: str, view: WorldView) -> "RayTracker":
        return RayTracker(name, self, view)


class RayTracker(SensorTracker):
    """Casts the rays of one sensor, at most once per state, and only if something reads them.

    `_sites` are the ids of the sites that the pattern is cast from.
    """

    def __init__(self, name: str, sensor: RayCaster, view: WorldView) -> None:
        self._sensor = sensor
        self._view = view
        self._key = f"rays/{name}"
        model = view.world.mj_model
        if sensor.sites:
            self._sites = view.resolver.ids("site", sensor.sites)
        else:
            self._sites = (int(model.site(sensor.mounting_site(name)).id),)
        # On the device once, since patterns do not change.
        start_N3, direction_N3 = (
            torch.tensor(table, dtype=torch.float32, device=view.device)
            for table in sensor.pattern.rays()
        )
        self._start_N3 = start_N3
        self._direction_N3 = direction_N3
        # A batch for each site, as each leaves out another body; -1 is none.
        self._batches: list[RayBatch] = []
        for site in self._sites:
            own = int(model.site_bodyid[site]) if sensor.exclude_body else -1
            self._batches.append(
                RayBatch(
                    view.world, len(start_N3), geom_groups=sensor.geom_groups, exclude_body=own
                )
            )

    @property
    def state(self) -> RayState:
        """The hits of the rays in the current state."""
        cache = self._view.cache
        # Once per state, however many terms read it.
        if self._key not in cache:
            cache[self._key] = self._cast()
        return cache[self._key]

    @property
    def origin_EN3(self) -> Float[Tensor, "E N 3"]:
        """Place of the sensor that each ray belongs to, world frame, m; position stage."""
        num_rays = len(self._start_N3)
        places = [self._origin(site)[:, None].expand(-1, num_rays, 3) for site in self._sites]
        return torch.cat(places, dim=1)

    def _origin(self, site: int) -> Float[Tensor, "E 3"]:
        return self._view.derived().site_xpos_EL[:, site]

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw a ball where each ray hits."""
        state = self.state
        points = state.point_EN3[env_index].cpu().numpy()
        for point, is_hit in zip(points, state.hit_EN[env_index].tolist(), strict=True):
            if is_hit:
                visualizer.sphere(point, radius=0.015, rgba=(0.9, 0.2, 0.2, 1.0))

    def _cast(self) -> RayState:
        """Cast the rays of all sites, one site after the other."""
        parts = [
            self._cast_from(site, batch)
            for site, batch in zip(self._sites, self._batches, strict=True)
        ]
        if len(parts) == 1:
            return parts[0]
        return RayState(*(torch.cat(leaves, dim=1) for leaves in zip(*parts, strict=True)))

    def _cast_from(self, site: int, batch: RayBatch) -> RayState:
        """Cast, and copy the hits: the next cast overwrites them."""
        most = self._sensor.max_distance
        # Inputs of the batch are written in place, since its kernels are bound to them.
        batch.start_EN3.copy_(self._origin(site)[:, None] + self._turned(site, self._start_N3))
        batch.direction_EN3.copy_(self._turned(site, self._direction_N3))
        batch.cast()
        # A negative distance means no hit.
        hit_EN = (batch.distance_EN >= 0.0) & (batch.distance_EN <= most)
        distance_EN = torch.where(hit_EN, batch.distance_EN, most)
        return RayState(
            distance_EN=distance_EN,
            hit_EN=hit_EN,
            # Rays without a hit end at `max_distance`.
            point_EN3=batch.start_EN3 + distance_EN[..., None] * batch.direction_EN3,
            normal_EN3=torch.where(hit_EN[..., None], batch.normal_EN3, 0.0),
        )

    def _turned(self, site: int, vectors_N3: Float[Tensor, "N 3"]) -> Tensor:
        """Turn vectors from the sensor's axes to the world's, [E, N, 3]."""
        if self._sensor.alignment == "world":
            return vectors_N3.expand(self._view.num_envs, -1, -1)
        # Columns are the site's axes in the world.
        matrix_E33 = self._view.derived().site_xmat_EL[:, site].view(-1, 3, 3)
        if self._sensor.alignment == "yaw":
            # The heading of the site's x axis.
            yaw_E1 = torch.atan2(matrix_E33[:, 1, 0], matrix_E33[:, 0, 0])[:, None]
            cos_E1 = torch.cos(yaw_E1)
            sin_E1 = torch.sin(yaw_E1)
            # A turn about the world's z axis; z stays.
            x_N, y_N, z_N = vectors_N3.unbind(-1)
            turned = (
                cos_E1 * x_N - sin_E1 * y_N,
                sin_E1 * x_N + cos_E1 * y_N,
                z_N.expand(len(cos_E1), -1),
            )
            return torch.stack(turned, dim=-1)
        # Rows times the transpose: each vector turned by the matrix.
        return product(vectors_N3, matrix_E33.mT)
