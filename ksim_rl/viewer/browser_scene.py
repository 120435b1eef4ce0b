"""A MuJoCo scene, as the pictures of videos are drawn from it, is shown by viser in a browser."""

import copy
from collections.abc import Collection
from typing import Any, TypeAlias

import mujoco
import numpy as np
import trimesh
import viser

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.scene.rendering.rendering import pose_env
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, visible_groups

# Room of MuJoCo's scene; geoms beyond it are dropped.
MOST_GEOMS = 20_000
_KIND = mujoco.mjtGeom
# Kinds whose shape stands in the model's data.
_OF_MODEL = (_KIND.mjGEOM_MESH, _KIND.mjGEOM_SDF, _KIND.mjGEOM_HFIELD)
# A line has no width in m; it is drawn with this one.
_LINE_RADIUS = 0.004
# Sides of round shapes: more cost time in the browser and look the same.
_SHADES = 24
_GROUND: dict[str, Any] = {
    "cell_size": 0.25, "cell_color": (180, 184, 190), "section_color": (166, 172, 180),
    "plane_color": (226, 230, 235), "plane_opacity": 1.0, "shadow_opacity": 0.25,
}  # fmt: skip
# Vertices [V, 3] in m, and triangles [F, 3] of their indices.
Mesh = tuple[np.ndarray, np.ndarray]
# The key of geoms that share a mesh: kind, number in the model, sizes that cannot be scaled, transparency.
Key: TypeAlias = tuple[Any, ...]


class SceneOfEnv:
    """The look of one env: a `mujoco.MjvScene` of its state, with the drawings of its terms for debugging."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        self._env = env
        # A copy, since each env that is shown writes its own fields into it.
        self.mj_model = copy.copy(env.world.mj_model)
        self.data = mujoco.MjData(self.mj_model)
        self.mjv = mujoco.MjvScene(self.mj_model, MOST_GEOMS)
        self.option = visible_groups(self.mj_model)
        self.drawings = env.setup_manager_visualizers()

    def fill(self, env_index: int, *, drawn: Collection[str], contacts: bool) -> None:
        """Take over the state of one env; `drawn` are the names in `drawings` that are drawn."""
        pose_env(self.mj_model, self.data, self._env.world, env_index)
        # Contacts are drawn only where they were computed for this state, below.
        self.option.flags[mujoco.mjtVisFlag.mjVIS_CONTACTPOINT] = contacts
        if contacts:
            mujoco.mj_collision(self.mj_model, self.data)
        # No camera and no mouse: a browser has its own of both.
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        nothing = (mujoco.MjvPerturb(), mujoco.MjvCamera())
        mujoco.mjv_updateScene(
            self.mj_model, self.data, self.option, *nothing, everything, self.mjv
        )
        # Drawn behind the model's own geoms, into the same list.
        visualizer = DebugVisualizer(self.mj_model, self.mjv)
        self._env.update_visualizers(visualizer, env_index, drawn=drawn)

    def center(self, body: str | None) -> np.ndarray:
        """Return where a camera looks that follows a body, by default the first that moves: m, world frame."""
        # Bodies that are welded to the world do not move; 0 is the world itself.
        moving = np.flatnonzero(self.mj_model.body_weldid)
        if body is not None:
            index = self.mj_model.body(body).id
        elif moving.size:
            index = int(moving[0])
        else:
            index = 0
        return self.data.xpos[index].copy()


class BrowserScene:
    """Shows a `mujoco.MjvScene`: geoms of one shape and transparency are instances of one mesh.

    Parts that did not change since the last frame are not sent again. `unknown` names the kinds that a browser cannot
    show.
    """

    def __init__(self, scene: viser.SceneApi, mj_model: mujoco.MjModel) -> None:
        self._scene = scene
        self._mj_model = mj_model
        self._root = scene.add_frame("/env", show_axes=False)
        # By key: the handle of the mesh, and the arrays that the browser has now.
        self._batches: dict[Key, tuple[viser.BatchedMeshHandle, dict[str, np.ndarray]]] = {}
        self._labels: list[viser.LabelHandle] = []
        self._planes: dict[int, viser.GridHandle] = {}
        self.unknown: set[str] = set()

    def show(self, mjv: mujoco.MjvScene, *, center: np.ndarray) -> None:
        """Show the scene, moved so that `center` (m) is above the origin, at which cameras look."""
        # One message for each mesh is far cheaper than one for each geom.
        batches: dict[Key, list[mujoco.MjvGeom]] = {}
        labels = []
        for index in range(mjv.ngeom):
            geom = mjv.geoms[index]
            if geom.type == _KIND.mjGEOM_LABEL:
                labels.append(geom)
            # Planes are no meshes: a grid is drawn once, and stays.
            elif geom.type == _KIND.mjGEOM_PLANE and geom.rgba[3] > 0:
                self._plane(geom)
            elif (key := self._key(geom)) is not None:
                batches.setdefault(key, []).append(geom)
        # The frame above all geoms is moved, so that no instance is sent again when the robot walks.
        self._root.position = (-float(center[0]), -float(center[1]), 0.0)
        # Also the meshes that have no geom any more: their instances have to vanish.
        for key in batches.keys() | self._batches.keys():
            self._batch(key, batches.get(key, []))
        self._write_labels(labels)

    def _key(self, geom: mujoco.MjvGeom) -> Key | None:
        """Return the key that geoms of one mesh share: kind, data, sizes that cannot be scaled, transparency."""
        # Two digits, so that fading geoms do not open a mesh for each shade.
        alpha = round(float(geom.rgba[3]), 2)
        kind = int(geom.type)
        if alpha == 0.0 or kind == _KIND.mjGEOM_NONE:
            return None
        if kind in _OF_MODEL:
            return kind, geom.dataid, alpha
        # A capsule cannot be scaled: its caps would become ellipsoids.
        if kind == _KIND.mjGEOM_CAPSULE:
            radius = round(float(geom.size[0]), 4)
            half_length = round(float(geom.size[2]), 4)
            return kind, radius, half_length, alpha
        if kind in _PRIMITIVES:
            return kind, alpha
        # Remembered by name; such geoms are not drawn.
        self.unknown.add(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower())
        return None

    def _batch(self, key: Key, geoms: list[mujoco.MjvGeom]) -> None:
        """Show these geoms as instances of one mesh; those that it had more of before shrink to nothing."""
        known = self._batches.get(key)
        # Batches only grow: another number of instances means a new mesh in the browser.
        count = max(len(geoms), 0 if known is None else len(known[1]["batched_positions"]))
        if known is not None and len(known[1]["batched_positions"]) < count:
            known[0].remove()
            known = None
        # Rows without a geom keep these values: they are scaled to almost nothing.
        values = {
            "batched_positions": np.zeros((count, 3), np.float32),
            "batched_wxyzs": np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            "batched_scales": np.full((count, 3), 1e-6, np.float32),
            "batched_colors": np.zeros((count, 3), np.uint8),
        }
        quat = np.zeros(4)
        for row, geom in enumerate(geoms):
            mujoco.mju_mat2Quat(quat, np.asarray(geom.mat, dtype=np.float64).ravel())
            values["batched_positions"][row] = geom.pos
            values["batched_wxyzs"][row] = quat
            values["batched_scales"][row] = _scale(key[0], geom.size)
            values["batched_colors"][row] = np.clip(geom.rgba[:3] * 255, 0, 255)
        if known is None:
            vertices, faces = self._mesh(key)
            handle = self._scene.add_batched_meshes_simple(
                f"/env/{'_'.join(str(item) for item in key)}",
                vertices,
                faces,
                values["batched_wxyzs"],
                values["batched_positions"],
                batched_scales=values["batched_scales"],
                batched_colors=values["batched_colors"],
                opacity=key[-1] if key[-1] < 1.0 else None,
                # Boxes have sharp edges; shared vertices would round them off.
                flat_shading=key[0] == _KIND.mjGEOM_BOX,
                cast_shadow=key[-1] == 1.0,
                # A height field has no underside, and a camera may look from below.
                side="double" if key[0] == _KIND.mjGEOM_HFIELD else "front",
                lod="off",
            )
        else:
            handle = known[0]
            # The most of a scene stands still: only arrays that changed are sent.
            for name, value in values.items():
                if not np.array_equal(value, known[1][name]):
                    setattr(handle, name, value)
        self._batches[key] = (handle, values)

    def _mesh(self, key: Key) -> Mesh:
        # Height fields count by their own number.
        if key[0] == _KIND.mjGEOM_HFIELD:
            return height_field_mesh(self._mj_model, key[1])
        if key[0] in _OF_MODEL:
            # Twice the number of the mesh, plus one for its convex hull.
            return mesh_of_model(self._mj_model, key[1] // 2)
        if key[0] == _KIND.mjGEOM_CAPSULE:
            body = trimesh.creation.capsule(height=2 * key[2], radius=key[1], count=(12, 12))
            # Trimesh's capsule begins at its lower cap; MuJoCo's centre is in the middle.
            middle = body.bounds.mean(axis=0)[2]
            vertices = np.asarray(body.vertices) - [0, 0, middle]
            return vertices, np.asarray(body.faces)
        return _PRIMITIVES[key[0]]

    def _plane(self, geom: mujoco.MjvGeom) -> None:
        # Planes do not change while an env is shown.
        if geom.objid in self._planes:
            return
        # In MuJoCo a size of 0 means an infinite plane.
        infinite = geom.size[0] <= 0 or geom.size[1] <= 0
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.asarray(geom.mat, dtype=np.float64).ravel())
        if infinite:
            # MuJoCo moves the picture of an infinite plane about with the camera.
            position = self._mj_model.geom_pos[geom.objid]
            width = 40.0
            height = 40.0
        else:
            position = geom.pos
            width = 2 * float(geom.size[0])
            height = 2 * float(geom.size[1])
        place = {"wxyz": quat, "position": np.asarray(position, dtype=np.float64)}
        extent = {
            "width": width,
            "height": height,
            "infinite_grid": infinite,
            "fade_distance": 30.0,
        }
        grid = self._scene.add_grid(f"/env/plane_{geom.objid}", **extent, **_GROUND, **place)
        self._planes[geom.objid] = grid

    def _write_labels(self, geoms: list[mujoco.MjvGeom]) -> None:
        # Handles of labels are kept, as creating one takes a message of its own.
        while len(self._labels) < len(geoms):
            self._labels.append(self._scene.add_label(f"/env/label_{len(self._labels)}", ""))
        for row, handle in enumerate(self._labels):
            handle.visible = row < len(geoms)
            if handle.visible:
                handle.text = str(geoms[row].label)
                handle.position = np.asarray(geoms[row].pos, dtype=np.float64)


def _scale(kind: int, size: np.ndarray) -> tuple[float, float, float]:
    # These have their size in their mesh.
    if kind in _OF_MODEL or kind == _KIND.mjGEOM_CAPSULE:
        return 1.0, 1.0, 1.0
    if kind == _KIND.mjGEOM_LINE:
        return _LINE_RADIUS, _LINE_RADIUS, float(size[2])
    return float(size[0]), float(size[1]), float(size[2])


def mesh_of_model(mj_model: mujoco.MjModel, mesh: int) -> Mesh:
    """Return a mesh with a vertex for each normal at a corner, so that edges stay as sharp as they are."""
    first = mj_model.mesh_faceadr[mesh]
    count = mj_model.mesh_facenum[mesh]
    corners = mj_model.mesh_face[first : first + count].reshape(-1)
    normals = mj_model.mesh_facenormal[first : first + count].reshape(-1)
    # Vertices with the same position and normal are merged; along a sharp edge each face keeps its own.
    both = np.stack([corners, normals], axis=1)
    pairs, faces = np.unique(both, axis=0, return_inverse=True)
    start = mj_model.mesh_vertadr[mesh]
    vertices = mj_model.mesh_vert[start + pairs[:, 0]]
    return vertices, faces.reshape(-1, 3).astype(np.uint32)


def height_field_mesh(mj_model: mujoco.MjModel, field: int) -> Mesh:
    """Return the surface of a height field as triangles, m, in the frame of its geom."""
    rows = int(mj_model.hfield_nrow[field])
    columns = int(mj_model.hfield_ncol[field])
    # Half extents in m, and the height of a sample of 1; the fourth is the depth below, which is not drawn.
    half_x, half_y, rise, _ = mj_model.hfield_size[field]
    start = mj_model.hfield_adr[field]
    height = mj_model.hfield_data[start : start + rows * columns] * rise
    along_x = np.linspace(-half_x, half_x, columns)
    along_y = np.linspace(-half_y, half_y, rows)
    y, x = np.meshgrid(along_y, along_x, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), height], axis=1)
    # Of each cell the lower left corner; two triangles fill it, wound to face up.
    row = np.arange(rows - 1)[:, None]
    corner = (row * columns + np.arange(columns - 1)).ravel()
    above = corner + columns
    lower = np.stack([corner, corner + 1, above + 1], axis=1)
    upper = np.stack([corner, above + 1, above], axis=1)
    return vertices, np.concatenate([lower, upper])


def _of_trimesh(*bodies: trimesh.Trimesh) -> Mesh:
    whole: Any = trimesh.util.concatenate(bodies)
    return np.asarray(whole.vertices), np.asarray(whole.faces)


def _tube(start: float, end: float) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(
        radius=1.0, segment=[[0, 0, start], [0, 0, end]], sections=_SHADES
    )


_BALL = _of_trimesh(trimesh.creation.icosphere(subdivisions=3))
# As wide beside its shaft as MuJoCo draws it.
_HEAD = trimesh.creation.cone(radius=1.75, height=0.25, sections=_SHADES).apply_translation(
    [0, 0, 0.75]
)
_PRIMITIVES: dict[int, Mesh] = {
    int(_KIND.mjGEOM_SPHERE): _BALL,
    int(_KIND.mjGEOM_ELLIPSOID): _BALL,
    int(_KIND.mjGEOM_BOX): _of_trimesh(trimesh.creation.box(extents=(2.0, 2.0, 2.0))),
    int(_KIND.mjGEOM_CYLINDER): _of_trimesh(_tube(-1.0, 1.0)),
    int(_KIND.mjGEOM_LINE): _of_trimesh(_tube(0.0, 1.0)),
    int(_KIND.mjGEOM_ARROW): _of_trimesh(_tube(0.0, 0.75), _HEAD),
}
