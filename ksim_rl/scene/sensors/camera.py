"""Renders the cameras of all worlds on the device."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from ksim_rl.checked import Count, Positive, Within
from ksim_rl.physics.ray_casting import BatchCamera, Picture
from ksim_rl.scene.rendering.visualizer import DebugVisualizer
from ksim_rl.scene.sensors.sensor import GeomGroup, Sensor, SensorTracker, check_present
from ksim_rl.scene.state.world_view import WorldView


@dataclass(frozen=True, kw_only=True)
class CameraSensor(Sensor):
    """A camera of the model, or a new one on a body, drawn when a term reads it (position stage).

    MuJoCo Warp's renderer casts a ray per pixel: colors, lights and textures resemble MuJoCo's own pictures without
    being equal to them, and depth and segmentation agree with them up to the edges of things.

    Attributes:
        camera: a camera of the model; None puts a new one on `body`, such as "world", at `pos`, m, with the picture's
            right and up along `xyaxes`, all in the body's frame, and a vertical field of view of `fovy` degrees.
        width, height: pixels.
        max_depth: m; depth of things that are farther, and of the background.
        geom_groups, textures: visible geoms and textures; the model's sky counts as a texture.
    """

    warp_alone: ClassVar[str] = "cameras of all worlds"

    camera: str | None = None
    body: str = "world"
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    xyaxes: tuple[float, float, float, float, float, float] = (0.0, -1.0, 0.0, 0.0, 0.0, 1.0)
    fovy: Annotated[float, Within(low=0.0, high=180.0, low_open=True)] = 45.0
    width: Count = 64
    height: Count = 64
    rgb: bool = True
    depth: bool = False
    segmentation: bool = False
    max_depth: Positive = 10.0
    geom_groups: tuple[GeomGroup, ...] = (0, 1, 2)
    textures: bool = True
    shadows: bool = False

    def _check_fields(self) -> None:
        super()._check_fields()
        # A camera that draws nothing would fail where it is read.
        if not (self.rgb or self.depth or self.segmentation):
            raise ValueError(
                "rgb=False, depth=False, segmentation=False: draw at least one of them"
            )

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the pixels of all worlds."""
        return {("width", "height"): num_envs * self.width * self.height}

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Add the camera `<name>` to its body, unless the model has it."""
        if self.camera is not None:
            check_present(name, "camera", self.camera, spec.cameras)
            return
        check_present(name, "body", self.body, spec.bodies)
        spec.body(self.body).add_camera(
            name=name, pos=list(self.pos), xyaxes=list(self.xyaxes), fovy=self.fovy
        )

    def picture(self) -> Picture:
        """Return what the renderer draws."""
        return Picture(
            width=self.width,
            height=self.height,
            rgb=self.rgb,
            depth=self.depth,
            segmentation=self.segmentation,
            geom_groups=self.geom_groups,
            textures=self.textures,
            shadows=self.shadows,
        )

    def track(self, name: str, view: WorldView) -> "CameraTracker":
        groups = view.world.mj_model.geom_group
        # Without a geom to draw, the renderer would abort the process.
        if not np.isin(groups, self.geom_groups).any():
            raise ValueError(
                f"scene.sensors.{name}.geom_groups={self.geom_groups}: no geom of the model is in one of them; its "
                f"geoms are in {sorted(set(groups.tolist()))}"
            )
        return CameraTracker(name, self, view)


class CameraTracker(SensorTracker):
    """Draws the pictures of one camera, at most once per state, and only if something reads them."""

    def __init__(self, name: str, sensor: CameraSensor, view: WorldView) -> None:
        self._name = name
        self._sensor = sensor
        self._view = view
        self._camera = BatchCamera(view.world, sensor.camera or name, sensor.picture())

    @property
    def rgb_EHW3(self) -> UInt8[Tensor, "E H W 3"]:
        """Colors; the first row is the top of the picture; position stage."""
        return self._read("rgb")

    @property
    def depth_EHW(self) -> Float[Tensor, "E H W"]:
        """Distance along the camera's axis, at most `max_depth`, m; position stage."""
        return self._read("depth")

    @property
    def segmentation_EHW(self) -> Int32[Tensor, "E H W"]:
        """Ids of the geoms that are seen, -1 for none; position stage."""
        return self._read("segmentation")

    def draw_debug(self, view: WorldView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the camera's axes: right in red, up in green, and back in blue."""
        camera = view.world.mj_model.camera(self._sensor.camera or self._name).id
        origin = view.world.view("cam_xpos")[env_index, camera].cpu().numpy()
        # MuJoCo's camera looks along -z: the third axis points back.
        visualizer.frame(
            origin, view.world.view("cam_xmat")[env_index, camera].cpu().numpy().reshape(3, 3)
        )

    def _read(self, output: str) -> Tensor:
        cache = self._view.cache
        key = f"camera/{self._name}."
        if key + output not in cache:
            # A picture that was not asked for is not drawn, and cannot be read.
            if not getattr(self._sensor, output):
                raise ValueError(
                    f"scene.sensors.{self._name}.{output}=False: set it to True to read it"
                )
            # Refuses to draw a state whose poses are stale.
            self._view.derived()
            self._camera.render()
            # All pictures of the camera come from one pass.
            cache.update({key + name: picture for name, picture in self._pictures().items()})
        return cache[key + output]

    def _pictures(self) -> dict[str, Tensor]:
        """Copy the last pictures: the next drawing overwrites them."""
        camera = self._camera
        sensor = self._sensor
        pictures = {}
        if sensor.rgb:
            pictures["rgb"] = camera.rgb_EHW3
        if sensor.depth:
            depth_EHW = camera.depth_EHW
            most = sensor.max_depth
            # The renderer gives 0 where a ray hits nothing.
            pictures["depth"] = torch.where(depth_EHW > 0.0, depth_EHW.clamp(max=most), most)
        if sensor.segmentation:
            # The first number is the geom's id.
            pictures["segmentation"] = camera.segmentation_EHW2[..., 0].clone()
        return pictures
