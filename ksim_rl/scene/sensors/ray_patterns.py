"""Bundles of rays in a sensor's own axes: x forward, y left, z up."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ksim_rl.checked import Checked, Count, Positive, Within


@dataclass(frozen=True, kw_only=True)
class RayPattern(Checked, ABC):
    """A bundle of N rays."""

    @abstractmethod
    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return where the rays start, m, and their unit directions, float64 [N, 3] each, in the sensor's axes."""


@dataclass(frozen=True, kw_only=True)
class GridPattern(RayPattern):
    """Parallel rays that start at the points of a grid, parallel to the sensor's xy plane.

    Points run along x (forward) first, from back to front, and these rows along y, from right to left.

    Attributes:
        size: edges of the grid along x and y, m.
        resolution: m between neighbouring points.
        height: m of the grid above the sensor: rays that start low do not see what is higher.
        direction: of the rays; its length does not matter.
    """

    size: Annotated[tuple[float, float], Within(low=0.0)] = (1.6, 1.0)
    resolution: Positive = 0.1
    height: float = 0.0
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.direction):
            raise ValueError(f"direction={self.direction!r}: expected a vector that is not zero")

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays."""
        start_N3 = grid_points(self.size, self.resolution) + np.array([0.0, 0.0, self.height])
        direction = np.asarray(self.direction) / np.linalg.norm(self.direction)
        return start_N3, np.broadcast_to(direction, start_N3.shape)


@dataclass(frozen=True, kw_only=True)
class PinholePattern(RayPattern):
    """The rays of a camera that looks along x: one through the middle of each pixel, row by row from the top left.

    Attributes:
        width, height: pixels.
        fovy: vertical field of view, degrees; pixels are square.
    """

    width: Count = 16
    height: Count = 12
    fovy: Annotated[float, Within(low=0.0, high=179.0, low_open=True)] = 60.0

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays."""
        pixel = 2.0 * math.tan(math.radians(self.fovy) / 2) / self.height
        left = ((self.width - 1) / 2 - np.arange(self.width)) * pixel
        up = ((self.height - 1) / 2 - np.arange(self.height)) * pixel
        up_N, left_N = (table.ravel() for table in np.meshgrid(up, left, indexing="ij"))
        return _from_origin(np.stack((np.ones_like(left_N), left_N, up_N), axis=-1))


@dataclass(frozen=True, kw_only=True)
class RingPattern(RayPattern):
    """The rays of a turning lidar: rings about z, one after the other, each from +x to the left all around.

    Attributes:
        num_rays: of one ring.
        elevations: degrees above the xy plane, one ring each.
    """

    num_rays: Count = 36
    elevations: tuple[Annotated[float, Within(low=-90.0, high=90.0)], ...] = (0.0,)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.elevations:
            raise ValueError("elevations=(): give at least one ring, such as (0.0,)")

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays."""
        around = 2 * np.pi * np.arange(self.num_rays) / self.num_rays
        up_N, around_N = (
            table.ravel() for table in np.meshgrid(np.radians(self.elevations), around, indexing="ij")
        )
        flat_N = np.cos(up_N)
        return _from_origin(
            np.stack((flat_N * np.cos(around_N), flat_N * np.sin(around_N), np.sin(up_N)), axis=-1)
        )


def grid_points(size: tuple[float, float], resolution: float) -> np.ndarray:
    """Return the points of a grid about the origin, m, [N, 3]: rows along x, one after the other along y; z is 0."""
    along_x, along_y = (
        (np.arange(count + 1) - count / 2) * resolution
        for count in (math.floor(edge / resolution + 1e-6) for edge in size)
    )
    y_N, x_N = (table.ravel() for table in np.meshgrid(along_y, along_x, indexing="ij"))
    return np.stack((x_N, y_N, np.zeros_like(x_N)), axis=-1)


def _from_origin(direction_N3: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    unit_N3 = direction_N3 / np.linalg.norm(direction_N3, axis=-1, keepdims=True)
    return np.zeros_like(unit_N3), unit_N3
