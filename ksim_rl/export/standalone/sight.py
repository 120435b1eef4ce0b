"""Draws a policy's pictures from the model of an exported folder, with MuJoCo's own renderer."""

import importlib
import os
import sys
from typing import Any

import mujoco
import numpy as np

from ksim_rl.export.standalone.files import Array, Json, check_count
from ksim_rl.export.standalone.signals import Lag, Signals

MOST_PIXELS = 4096
"""In a row or a column."""
OFF_LIGHT = 32
"""Of 255, beyond which a pixel counts as another one than was recorded."""
OFF_DEPTH = 0.02
"""Of a distance, with 1 cm more, beyond which a pixel counts as another one."""
DTYPES = {"rgb": "uint8", "depth": "float32"}


class Camera:
    """One camera of the model, as an entry of `pictures` describes its pictures."""

    def __init__(self, signals: Signals, spec: Json) -> None:
        self.spec = spec
        self.signals = signals
        self.output = str(spec["output"])
        height, width = spec["shape"][:2]
        for edge in (height, width):
            check_count("edge of a picture", edge, MOST_PIXELS)
        colors = [3] if self.output == "rgb" else []
        fits = spec["dtype"] == DTYPES.get(self.output) and spec["shape"][2:] == colors
        if not fits or not height or not width:
            raise ValueError(f"export.json: {str(spec)[:200]}: no picture of rgb or depth")
        try:
            self.camera = int(signals.model.camera(spec["camera"]).id)
        except KeyError as error:
            raise ValueError(f"export.json: pictures: {error}") from None
        self.option = mujoco.MjvOption()
        for group in range(len(self.option.geomgroup)):
            self.option.geomgroup[group] = group in spec["geom_groups"]
        self.option.flags[mujoco.mjtVisFlag.mjVIS_TEXTURE] = bool(spec["textures"])
        # Sites are marks, which no robot has.
        self.option.sitegroup[:] = 0
        self.renderer: Any = None

    def drawn(self) -> Array:
        """Return the picture of the current state."""
        if self.renderer is None:
            self.renderer = self._open()
        renderer = self.renderer
        renderer.update_scene(self.signals.data, self.camera, self.option)
        flags = renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = bool(self.spec["shadows"])
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = bool(self.spec["textures"])
        picture = renderer.render()
        if self.output == "depth":
            picture = np.minimum(picture, np.float32(self.spec["max_depth"]))
        return picture.copy()

    def _open(self) -> Any:
        choose_platform()
        height, width = self.spec["shape"][:2]
        model = self.signals.model
        # One ray for each pixel in training: no smooth edges.
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, height)
        try:
            renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # MuJoCo's platforms raise whatever their loader raises
            raise ValueError(
                f"the policy sees by the camera {self.spec['camera']!r}, and nothing draws its pictures here: "
                f"{type(error).__name__}: {' '.join(str(error).split())[:200]}; set MUJOCO_GL to egl (Debian: libegl1 "
                "libgles2), osmesa (libosmesa6), or glfw with a display"
            ) from error
        if self.output == "depth":
            renderer.enable_depth_rendering()
        return renderer

    def share_off(self, picture: Array) -> float:
        """Return the share of pixels that differ from a picture of the same state."""
        own = self.drawn().astype(float)
        error = np.abs(own - picture)
        if self.output == "depth":
            return float((error > OFF_DEPTH * np.abs(picture) + 0.01).mean())
        return float((error.max(-1) > OFF_LIGHT).mean())


class Sight:
    """The pictures of a policy's cameras, at their rates, with their losses and lags."""

    def __init__(self, signals: Signals) -> None:
        self.draws = signals
        self.cameras: dict[str, Camera] = {}
        self.lags: dict[str, Lag] = {}
        for spec in signals.meta.get("pictures", []):
            name = spec["input"]
            self.cameras[name] = Camera(signals, spec)
            check_count("env steps of a camera", spec["every"])
            if spec["delay"]:
                self.lags[name] = Lag(spec["delay"], signals)
        self.held: dict[str, Array] = {}
        self.phases: dict[str, int] = {}
        self.age = 0

    def reset(self) -> None:
        """Begin an episode."""
        self.held.clear()
        self.age = 0
        for delay in self.lags.values():
            delay.reset()
        for name, camera in self.cameras.items():
            # Cameras do not wait for robots.
            self.phases[name] = int(self.draws.draws.integers(1, max(camera.spec["every"], 1) + 1))

    def drawn(self) -> dict[str, Array]:
        """Return the pictures of the current state, by input."""
        return {name: camera.drawn() for name, camera in self.cameras.items()}

    def __call__(self, advances: bool) -> dict[str, Array]:
        """Return the pictures that the policy reads in this env step; call it once for each."""
        self.age += advances
        found = {}
        for name, camera in self.cameras.items():
            if name not in self.held or self._arrives(name, camera.spec):
                self.held[name] = camera.drawn()
            found[name] = self.held[name]
            if name in self.lags:
                found[name] = self.lags[name](found[name], advances)
        return found

    def _arrives(self, name: str, spec: Json) -> bool:
        every = max(spec["every"], 1)
        if (self.age - self.phases[name]) % every:
            return False
        return not spec["dropped"] or self.draws.draws.random() >= spec["dropped"]


def choose_platform() -> None:
    """Let MuJoCo draw without a display, unless MUJOCO_GL says how."""
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY"):
        return
    os.environ["MUJOCO_GL"] = "egl"
    # MuJoCo reads the variable when it is imported, which has happened.
    importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
