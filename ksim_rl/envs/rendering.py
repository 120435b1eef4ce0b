"""Pictures of an env, drawn off screen by MuJoCo's own renderer."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from ksim_rl.checks import near
from ksim_rl.envs.gl_platform import FIXES, choose_gl_platform
from ksim_rl.envs.viewer_cfg import ViewerCfg
from ksim_rl.envs.visualizer import DebugVisualizer, SceneVisualizer, add_geoms, visible_groups
from ksim_rl.physics import World

class OffscreenRenderer:
    """Draws one env, or several side by side, with the camera of a `ViewerCfg`.

    The OpenGL context is opened at the first picture, so that an env with a render mode can be built anywhere.

    Raises:
        ValueError: if the camera tracks a body that the model does not have.
    """

    def __init__(self, model: mujoco.MjModel, cfg: ViewerCfg, *, spacing: float) -> None:
        self._model, self._cfg, self._spacing = model, cfg, spacing
        self._data = mujoco.MjData(model)
        self._renderer: mujoco.Renderer | None = None
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.elevation = cfg.distance, cfg.elevation
        self._camera.azimuth = cfg.azimuth
        self._body: int | None = None
        if cfg.body is not None:
            names = [model.body(i).name for i in range(model.nbody)]
            if cfg.body not in names:
                raise ValueError(f"viewer.body={cfg.body!r}: {near(cfg.body, names)}")
            self._body = names.index(cfg.body)

    def render(self, world: World, *, draw: Callable[[DebugVisualizer], None]) -> np.ndarray:
        """Return a picture of the current state, uint8 [H, W, 3]; `draw` adds the debug drawing.

        Raises:
            RuntimeError: if no OpenGL platform works, with the ways to get one.
        """
        renderer = self._open()
        first, last = self._cfg.env_index, min(self._cfg.env_index + self._cfg.num_envs, world.num_envs)
        qpos_EL = world.qpos_EL[first:last].detach().cpu().numpy()
        self._pose(qpos_EL[0])
        target = self._cfg.lookat if self._body is None else self._data.xpos[self._body]
        self._camera.lookat[:] = target
        renderer.update_scene(self._data, self._camera, visible_groups(self._model))
        draw(SceneVisualizer(self._model, renderer.scene))
        columns = int(np.ceil(np.sqrt(len(qpos_EL))))
        for index, qpos in enumerate(qpos_EL[1:], start=1):
            self._pose(qpos)
            row, column = divmod(index, columns)
            add_geoms(
                self._model,
                self._data,
                renderer.scene,
                np.array([column * self._spacing, row * self._spacing, 0.0]),
            )
        return renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _pose(self, qpos: np.ndarray) -> None:
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        mujoco.mj_tendon(self._model, self._data)

    def _open(self) -> mujoco.Renderer:
        if self._renderer is None:
            platform = choose_gl_platform()
            try:
                self._renderer = mujoco.Renderer(
                    _with_buffer(self._model, self._cfg), self._cfg.height, self._cfg.width, max_geom=20_000
                )
            except Exception as error:  # MuJoCo's platforms raise whatever their loader raises
                raise RuntimeError(f"{FIXES}. MUJOCO_GL is {platform!r}, and it said: {error}") from error
        return self._renderer


def _with_buffer(model: mujoco.MjModel, cfg: ViewerCfg) -> mujoco.MjModel:
    """Make the model's off-screen buffer large enough for the picture."""
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, cfg.width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, cfg.height)
    return model
