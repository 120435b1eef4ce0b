"""Draws pictures of an env off screen, by MuJoCo's renderer on an OpenGL platform that works here."""

import copy
import importlib
import os
from collections.abc import Callable
from functools import cache
from subprocess import TimeoutExpired

import mujoco
import numpy as np

from ksim_rl.checks import near
from ksim_rl.config.child_processes import run_python
from ksim_rl.physics import World
from ksim_rl.physics.fields import write_fields
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, add_geoms, place, visible_groups
from ksim_rl.scene.viewer_cfg import ViewerCfg

_PROBE = "import mujoco; context = mujoco.GLContext(16, 16); context.make_current(); context.free()"
_PROBE_SECONDS = 60
_FIXES = (
    "no OpenGL platform for off-screen rendering. Fixes: EGL, from a GPU's driver or Mesa (Debian: libegl1 libgles2); "
    "OSMesa, in software (Debian: libosmesa6); or a display, real or virtual (Xvfb :1 & DISPLAY=:1 MUJOCO_GL=glfw)"
)


@cache
def choose_gl_platform() -> str:
    """Make MuJoCo draw with a platform that works, and return its name; a RuntimeError tells how to get one.

    The environment variable MUJOCO_GL has the last word. Without it each candidate is tried in a process of its own,
    because a platform that fails cannot be exchanged for another in the same process.
    """
    if os.environ.get("MUJOCO_GL"):
        # The user's choice is not tried.
        return os.environ["MUJOCO_GL"]
    said = []
    # A display first, since it needs no driver for off-screen pictures.
    for platform in (["glfw"] if os.environ.get("DISPLAY") else []) + ["egl", "osmesa"]:
        environment = {"MUJOCO_GL": platform}
        try:
            # In a child process: a platform that fails may abort its process.
            tried = run_python(["-c", _PROBE], environment=environment, seconds=_PROBE_SECONDS)
        except TimeoutExpired:
            said.append(f"{platform}: no answer in {_PROBE_SECONDS} s")
            continue
        if tried.returncode == 0:
            os.environ["MUJOCO_GL"] = platform
            # MuJoCo reads the variable when it is imported, which has happened.
            importlib.reload(importlib.import_module("mujoco.rendering.classic.gl_context"))
            return platform
        said.append(f"{platform}: {(tried.stderr.strip().splitlines() or ['failed'])[-1]}")
    raise RuntimeError(f"{_FIXES}. Tried {'; '.join(said)}")


class OffscreenRenderer:
    """Draws one env, or several side by side, with the camera of a `ViewerCfg`.

    The OpenGL context is opened at the first picture, so that an env with a render mode can be built anywhere.
    """

    def __init__(self, mj_model: mujoco.MjModel, cfg: ViewerCfg, *, spacing: float) -> None:
        # A copy, since each env that is drawn writes its own fields into it.
        self._mj_model = copy.copy(mj_model)
        self._cfg = cfg
        self._spacing = spacing
        self._data = mujoco.MjData(self._mj_model)
        self._renderer: mujoco.Renderer | None = None
        self._camera = mujoco.MjvCamera()
        self._camera.distance = cfg.distance
        self._camera.elevation = cfg.elevation
        self._camera.azimuth = cfg.azimuth
        self._body: int | None = None
        if cfg.body is not None:
            names = [mj_model.body(i).name for i in range(mj_model.nbody)]
            if cfg.body not in names:
                raise ValueError(f"viewer.body={cfg.body!r}: {near(cfg.body, names)}")
            self._body = names.index(cfg.body)

    def render(self, world: World, *, draw: Callable[[DebugVisualizer, int], None]) -> np.ndarray:
        """Return a picture of the current state, uint8 [H, W, 3]; `draw` adds the debug drawing of one env."""
        # The context is opened at the first picture.
        renderer = self._open()
        first = self._cfg.env_index
        # The world may have fewer envs than the viewer wants.
        last = min(self._cfg.env_index + self._cfg.num_envs, world.num_envs)
        pose_env(self._mj_model, self._data, world, first)
        # Without a body to follow the camera looks at a fixed point.
        if self._body is None:
            target = self._cfg.lookat
        else:
            target = self._data.xpos[self._body]
        self._camera.lookat[:] = target
        renderer.update_scene(self._data, self._camera, visible_groups(self._mj_model))
        for light in renderer.scene.lights[: renderer.scene.nlight]:
            # It shines everywhere, but MuJoCo draws shadows near its place only.
            if light.type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                light.pos[:2] = target[:2]
        # The first env is the scene itself; others are added beside it.
        draw(DebugVisualizer(self._mj_model, renderer.scene), first)
        # About as many rows as columns.
        columns = int(np.ceil(np.sqrt(last - first)))
        for index in range(1, last - first):
            pose_env(self._mj_model, self._data, world, first + index)
            row, column = divmod(index, columns)
            offset = np.array([column * self._spacing, row * self._spacing, 0.0])
            add_geoms(self._mj_model, self._data, renderer.scene, offset)
            # Height fields may differ between envs, and are static: they are not among the moving geoms.
            if self._mj_model.nhfield:
                static = mujoco.mjtCatBit.mjCAT_STATIC
                add_geoms(self._mj_model, self._data, renderer.scene, offset, category=static)
            draw(DebugVisualizer(self._mj_model, renderer.scene, offset), first + index)
        return renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _open(self) -> mujoco.Renderer:
        if self._renderer is None:
            platform = choose_gl_platform()
            try:
                vis = self._mj_model.vis.global_
                cfg = self._cfg
                # MuJoCo refuses pictures that are larger than its off-screen buffer.
                vis.offwidth = max(vis.offwidth, cfg.width)
                vis.offheight = max(vis.offheight, cfg.height)
                self._renderer = mujoco.Renderer(
                    self._mj_model, cfg.height, cfg.width, max_geom=20_000
                )
            except Exception as error:  # MuJoCo's platforms raise whatever their loader raises
                raise RuntimeError(
                    f"{_FIXES}. MUJOCO_GL is {platform!r}, and it said: {error}"
                ) from error
        return self._renderer


def pose_env(mj_model: mujoco.MjModel, data: mujoco.MjData, world: World, env: int) -> None:
    """Take over the visible state of one env: its positions, and its own fields, which are written into `mj_model`."""
    write_fields(
        mj_model,
        {name: field[env].cpu().numpy() for name, field in world.per_world_fields().items()},
    )
    data.qpos[:] = world.qpos_EL[env].cpu()
    if mj_model.nmocap:
        data.mocap_pos[:] = world.view("mocap_pos")[env].cpu()
        data.mocap_quat[:] = world.view("mocap_quat")[env].cpu()
    place(mj_model, data)
