"""What a browser is sent of a MuJoCo scene equals what MuJoCo draws."""

import mujoco
import numpy as np
import pytest

from ksim_rl import envs

pytest.importorskip("viser", reason="viser is not installed (the extra `viewer`)")
from ksim_rl.viewer.browser_scene import (
    BrowserScene,
    SceneOfEnv,
    height_field_mesh,
    mesh_of_model,
)

TETRAHEDRON = "0 0 0  1 0 0  0 1 0  0 0 1"


class Recorder:
    """Stands in for viser's scene, and keeps the calls."""

    def __init__(self):
        self.meshes, self.grids, self.labels = {}, [], []

    def add_frame(self, name, **_):
        return type("Frame", (), {"position": None})()

    def add_grid(self, name, **how):
        self.grids.append(how)

    def add_label(self, name, text):
        label = type("Label", (), {"text": text, "visible": True, "position": None})()
        self.labels.append(label)
        return label

    def add_batched_meshes_simple(
        self, name, vertices, faces, wxyzs, positions, *, batched_scales, **how
    ):
        batch = type("Batch", (), {"remove": lambda self: None})()
        batch.vertices, batch.faces, batch.how = np.asarray(vertices), np.asarray(faces), how
        batch.batched_wxyzs, batch.batched_positions, batch.batched_scales = (
            wxyzs,
            positions,
            batched_scales,
        )
        batch.batched_colors = how["batched_colors"]
        self.meshes[name] = batch
        return batch

    def corners(self):
        """All vertices as they stand in the world, of each mesh."""
        return {
            name: np.concatenate([_placed(batch, row) for row in _shown(batch)])
            for name, batch in self.meshes.items()
        }


def _shown(batch):
    return [row for row, scale in enumerate(batch.batched_scales) if scale[0] > 1e-5]


def _placed(batch, row):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(batch.batched_wxyzs[row], dtype=np.float64))
    return (batch.vertices * batch.batched_scales[row]) @ matrix.reshape(
        3, 3
    ).T + batch.batched_positions[row]


def shown(xml: str, *, change=lambda scene: None) -> Recorder:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, 100)
    everything, nothing = (
        mujoco.mjtCatBit.mjCAT_ALL.value,
        (mujoco.MjvPerturb(), mujoco.MjvCamera()),
    )
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), *nothing, everything, scene)
    change(scene)
    recorder = Recorder()
    browser = BrowserScene(recorder, model)
    browser.show(scene, center=np.zeros(3))
    assert not browser.unknown
    return recorder


def test_primitives_have_their_size_and_place():
    recorder = shown(
        "<mujoco><worldbody>"
        "<geom type='box' size='.1 .2 .3' pos='1 2 3'/>"
        "<geom type='capsule' size='.1 .3' pos='0 0 1' euler='0 90 0'/>"
        "<geom type='cylinder' size='.2 .4' pos='5 0 0'/>"
        "<geom type='ellipsoid' size='.1 .2 .3' pos='0 7 0'/>"
        "<geom type='plane' size='0 0 1'/>"
        "</worldbody></mujoco>"
    )
    bounds = {
        (tuple(c.min(0).round(2)), tuple(c.max(0).round(2))) for c in recorder.corners().values()
    }
    assert bounds == {
        ((0.9, 1.8, 2.7), (1.1, 2.2, 3.3)),
        ((-0.4, -0.1, 0.9), (0.4, 0.1, 1.1)),
        ((4.8, -0.2, -0.4), (5.2, 0.2, 0.4)),
        ((-0.1, 6.8, -0.3), (0.1, 7.2, 0.3)),
    }
    assert len(recorder.grids) == 1 and recorder.grids[0]["infinite_grid"]


def test_a_mesh_keeps_its_triangles():
    xml = (
        f"<mujoco><asset><mesh name='m' vertex='{TETRAHEDRON}'/></asset><worldbody>"
        "<geom type='mesh' mesh='m' pos='1 1 1' rgba='1 0 0 1'/><geom type='mesh' mesh='m' rgba='0 0 1 .5'/>"
        "</worldbody></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(xml)
    vertices, faces = mesh_of_model(model, 0)
    triangles = {tuple(sorted(map(tuple, vertices[face].round(4).tolist()))) for face in faces}
    own = {
        tuple(sorted(map(tuple, model.mesh_vert[face].round(4).tolist())))
        for face in model.mesh_face
    }
    assert triangles == own and len(triangles) == 4
    batches = shown(xml).meshes.values()  # two, as one of them is transparent
    assert sorted(batch.how["opacity"] or 1.0 for batch in batches) == [0.5, 1.0]
    first = next(batch for batch in batches if batch.how["opacity"] is None)
    assert first.batched_colors.tolist() == [[255, 0, 0]]
    corners = _placed(first, 0)
    assert corners.min(0) == pytest.approx([1, 1, 1], abs=1e-5) and corners.max(0) == pytest.approx(
        [2, 2, 2], abs=1e-5
    )


def test_a_height_field_has_its_heights():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><asset><hfield name='h' nrow='2' ncol='3' size='3 2 1 .1' elevation='0 0 0  1 .5 0'/></asset>"
        "<worldbody><geom type='hfield' hfield='h'/></worldbody></mujoco>"
    )
    vertices, faces = height_field_mesh(model, 0)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for x, y in ((-2.9, 1.9), (0.1, 0.4), (2.0, -1.0)):
        down, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
        distance = mujoco.mj_ray(model, data, np.array([x, y, 5.0]), down, None, 1, -1, hit, None)
        # Which diagonal is split.
        assert _height(vertices, faces, x, y) == pytest.approx(5.0 - distance, abs=0.13)
    assert (
        np.cross(
            vertices[faces[:, 1]] - vertices[faces[:, 0]],
            vertices[faces[:, 2]] - vertices[faces[:, 0]],
        )[:, 2].min()
        > 0
    )


def _height(vertices, faces, x, y):
    for a, b, c in vertices[faces]:
        weights = np.linalg.solve(
            np.stack([b[:2] - a[:2], c[:2] - a[:2]], axis=1), np.array([x, y]) - a[:2]
        )
        if min(*weights, 1 - weights.sum()) >= -1e-9:
            return a[2] + weights @ np.array([b[2] - a[2], c[2] - a[2]])
    raise AssertionError("outside of the field")


def test_arrows_lines_and_labels_stand_where_they_are_drawn():
    from ksim_rl.scene.rendering.visualizer import DebugVisualizer

    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")

    def draw(scene):
        visualizer = DebugVisualizer(model, scene)
        visualizer.arrow((0, 0, 0), (1, 0, 0), rgba=(0, 1, 0, 1), width=0.02)
        visualizer.line((0, 2, 0), (0, 3, 0), rgba=(0, 1, 0, 1))
        visualizer.text((1, 2, 3), "in the air")

    recorder = shown("<mujoco><worldbody/></mujoco>", change=draw)
    arrow, line = (corners for _, corners in sorted(recorder.corners().items()))
    assert arrow.min(0) == pytest.approx([0, -0.035, -0.035], abs=0.002) and arrow[
        :, 0
    ].max() == pytest.approx(1)
    assert (line[:, 1].min(), line[:, 1].max()) == pytest.approx((2, 3))
    assert recorder.labels[0].text == "in the air" and recorder.labels[0].position.tolist() == [
        1,
        2,
        3,
    ]


def test_what_moves_is_sent_anew_and_what_is_gone_shrinks():
    env = envs.make("cartpole_swingup", num_envs=1, seed=0)
    scene = SceneOfEnv(env.base_env)
    recorder = Recorder()
    browser = BrowserScene(recorder, scene.mj_model)
    env.reset()
    scene.fill(0, drawn=(), contacts=False)
    browser.show(scene.mjv, center=scene.center(None))
    before = {name: batch.batched_positions for name, batch in recorder.meshes.items()}
    env.base_env.world.qpos_EL[0, 0] += 0.5
    scene.fill(0, drawn=(), contacts=False)
    browser.show(scene.mjv, center=scene.center(None))
    moved = {
        name
        for name, batch in recorder.meshes.items()
        if batch.batched_positions is not before[name]
    }
    assert moved and moved < set(before) | moved
    scene.mjv.ngeom = 0
    browser.show(scene.mjv, center=np.zeros(3))
    assert not any(_shown(batch) for batch in recorder.meshes.values())
