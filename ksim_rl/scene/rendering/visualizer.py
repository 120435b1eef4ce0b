"""Draws the debug marks of terms into a MuJoCo scene."""

from collections.abc import Sequence

import mujoco
import numpy as np

from ksim_rl.physics.load import caught_warnings

Vector = Sequence[float] | np.ndarray
Rgba = tuple[float, float, float, float]


class DebugVisualizer:
    """The pen of commands, rewards and sensors: m, world frame; colors in [0, 1].

    It draws into a `mujoco.MjvScene`; marks beyond the scene's capacity are refused, not dropped.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, scene: mujoco.MjvScene, offset: Vector = (0.0, 0.0, 0.0)
    ) -> None:
        self._mj_model = mj_model
        self._scene = scene
        # Where the env stands in a picture of several.
        self._offset = np.asarray(offset, dtype=np.float64)

    def arrow(self, start: Vector, end: Vector, *, rgba: Rgba, width: float = 0.02) -> None:
        """Draw an arrow from `start` to `end`."""
        self._connector(mujoco.mjtGeom.mjGEOM_ARROW, width, start, end, rgba)

    def sphere(self, center: Vector, *, radius: float, rgba: Rgba) -> None:
        """Draw a ball."""
        self._next(mujoco.mjtGeom.mjGEOM_SPHERE, np.full(3, radius), center, rgba)

    def frame(self, origin: Vector, rotation: np.ndarray, *, scale: float = 0.1) -> None:
        """Draw the axes of a rotation matrix [3, 3] in red, green and blue."""
        # Columns of the matrix are the axes.
        for axis in range(3):
            rgba = (float(axis == 0), float(axis == 1), float(axis == 2), 1.0)
            end = np.asarray(origin) + scale * np.asarray(rotation)[:, axis]
            # In proportion, so that short axes stay thin.
            self._connector(mujoco.mjtGeom.mjGEOM_CYLINDER, scale / 20, origin, end, rgba)

    def line(self, start: Vector, end: Vector, *, rgba: Rgba) -> None:
        """Draw a line, two pixels wide."""
        self._connector(mujoco.mjtGeom.mjGEOM_LINE, 2.0, start, end, rgba)

    def ghost(self, qpos: np.ndarray, *, rgba: Rgba) -> None:
        """Draw the robot in another pose, transparently."""
        data = mujoco.MjData(self._mj_model)
        data.qpos[:] = qpos
        place(self._mj_model, data)
        # Geoms that are added from here on are the ghost's.
        first = self._scene.ngeom
        add_geoms(self._mj_model, data, self._scene, self._offset)
        for index in range(first, self._scene.ngeom):
            # One translucent colour, whatever the geoms' own.
            self._scene.geoms[index].rgba[:] = rgba

    def text(self, position: Vector, content: str) -> None:
        """Write a label."""
        geom = self._next(
            mujoco.mjtGeom.mjGEOM_LABEL, np.full(3, 0.1), position, (1.0, 1.0, 1.0, 1.0)
        )
        geom.label = content

    def _next(
        self, kind: mujoco.mjtGeom, size: np.ndarray, position: Vector, rgba: Rgba
    ) -> mujoco.MjvGeom:
        if self._scene.ngeom >= self._scene.maxgeom:
            raise RuntimeError(_full(self._scene))
        geom = self._scene.geoms[self._scene.ngeom]
        # In the picture's frame.
        center = np.asarray(position, dtype=np.float64) + self._offset
        # Unit orientation; connectors turn it afterwards.
        mujoco.mjv_initGeom(
            geom, kind, size, center, np.eye(3).ravel(), np.asarray(rgba, dtype=np.float32)
        )
        self._scene.ngeom += 1
        return geom

    def _connector(
        self, kind: mujoco.mjtGeom, width: float, start: Vector, end: Vector, rgba: Rgba
    ) -> None:
        geom = self._next(kind, np.zeros(3), start, rgba)
        # Both ends move with the env.
        begin, finish = (
            np.asarray(point, dtype=np.float64) + self._offset for point in (start, end)
        )
        mujoco.mjv_connector(geom, kind, width, begin, finish)


def place(mj_model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Compute the visible poses from `data.qpos` and the mocap poses."""
    # No dynamics: a picture needs poses only.
    mujoco.mj_kinematics(mj_model, data)
    mujoco.mj_comPos(mj_model, data)
    mujoco.mj_camlight(mj_model, data)
    mujoco.mj_tendon(mj_model, data)


def visible_groups(mj_model: mujoco.MjModel) -> mujoco.MjvOption:
    """Return drawing options that show something of the robot.

    MuJoCo hides geom groups 3 to 5, where collision geoms are by custom. A robot without visual geoms would be
    invisible, so for such a model they are shown.
    """
    option = mujoco.MjvOption()
    # Geoms of bodies that are welded to the world are the ground.
    moving = mj_model.geom_group[mj_model.body_weldid[mj_model.geom_bodyid] != 0]
    if moving.size and moving.min() > 2:
        option.geomgroup[moving.min()] = 1
    return option


def add_geoms(
    mj_model: mujoco.MjModel,
    data: mujoco.MjData,
    scene: mujoco.MjvScene,
    offset: np.ndarray,
    *,
    category: mujoco.mjtCatBit = mujoco.mjtCatBit.mjCAT_DYNAMIC,
) -> None:
    """Add the geoms of a category (those that move, by default) of `data` to the scene, shifted by `offset` (m)."""
    first = scene.ngeom
    # A full scene gives a warning of its own; the error below names the fix.
    with caught_warnings():
        mujoco.mjv_addGeoms(
            mj_model, data, visible_groups(mj_model), mujoco.MjvPerturb(), category.value, scene
        )
    if scene.status:
        raise RuntimeError(_full(scene))
    # Only those that were just added.
    for index in range(first, scene.ngeom):
        scene.geoms[index].pos[:] += offset


def _full(scene: mujoco.MjvScene) -> str:
    return f"the scene is full: {scene.maxgeom} geoms; draw fewer envs (viewer.num_envs) or fewer marks"
