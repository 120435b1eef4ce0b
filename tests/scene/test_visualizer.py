"""Debug drawing into a scene, which needs no OpenGL."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.rendering.visualizer import DebugVisualizer, add_geoms, visible_groups
from tests.envs.probe_env import PUCK_XML

RED = (1.0, 0.0, 0.0, 1.0)
MODEL = mujoco.MjModel.from_xml_string(PUCK_XML)


def empty_scene(capacity=20):
    return mujoco.MjvScene(MODEL, maxgeom=capacity)


def drawn(draw, offset=(0.0, 0.0, 0.0)):
    scene = empty_scene()
    draw(DebugVisualizer(MODEL, scene, offset))
    return [scene.geoms[i] for i in range(scene.ngeom)]


def direction(geom):
    return np.asarray(geom.mat)[:, 2]


def test_a_sphere():
    (geom,) = drawn(lambda v: v.sphere((1, 2, 3), radius=0.25, rgba=RED))
    assert geom.type == mujoco.mjtGeom.mjGEOM_SPHERE
    np.testing.assert_allclose(geom.pos, (1, 2, 3))
    np.testing.assert_allclose(geom.size, 0.25)
    np.testing.assert_allclose(geom.rgba, RED)


def test_an_arrow_points_from_start_to_end():
    (geom,) = drawn(lambda v: v.arrow((1, 0, 0), (1, 0.5, 0), rgba=RED, width=0.03))
    assert geom.type == mujoco.mjtGeom.mjGEOM_ARROW
    np.testing.assert_allclose(direction(geom), (0, 1, 0), atol=1e-6)
    np.testing.assert_allclose(geom.size[:2], 0.03)
    np.testing.assert_allclose(geom.size[2], 0.5)
    np.testing.assert_allclose(geom.pos, (1, 0, 0))


def test_a_line_joins_two_points():
    (geom,) = drawn(lambda v: v.line((0, 0, 0), (0, 0, 2), rgba=RED))
    assert geom.type == mujoco.mjtGeom.mjGEOM_LINE
    np.testing.assert_allclose(direction(geom), (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(geom.size[2], 2.0)


def test_a_frame_shows_three_axes_in_red_green_and_blue():
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    axes = drawn(lambda v: v.frame((0, 0, 1), quarter_turn, scale=0.4))
    assert len(axes) == 3
    np.testing.assert_allclose([direction(axis) for axis in axes], quarter_turn.T, atol=1e-6)
    np.testing.assert_allclose([axis.rgba[:3] for axis in axes], np.eye(3))
    for axis in axes:  # a cylinder's size holds its half length, and its position is its middle
        np.testing.assert_allclose(axis.pos, np.array((0, 0, 1)) + 0.2 * direction(axis), atol=1e-6)


def test_a_label():
    (geom,) = drawn(lambda v: v.text((0, 0, 1), "env 3"))
    assert geom.type == mujoco.mjtGeom.mjGEOM_LABEL and geom.label == "env 3"


def test_a_ghost_is_the_robot_in_another_pose_and_color():
    (geom,) = drawn(lambda v: v.ghost(np.array([2.5]), rgba=(0.0, 1.0, 0.0, 0.3)))
    assert geom.type == mujoco.mjtGeom.mjGEOM_SPHERE
    np.testing.assert_allclose(geom.pos, (2.5, 0, 0), atol=1e-6)
    np.testing.assert_allclose(geom.rgba, (0.0, 1.0, 0.0, 0.3))


def test_an_offset_moves_all_that_is_drawn():
    def everything(visualizer):
        visualizer.sphere((0, 0, 0), radius=0.1, rgba=RED)
        visualizer.arrow((0, 0, 0), (1, 0, 0), rgba=RED)
        visualizer.text((0, 0, 0), "here")
        visualizer.ghost(np.array([0.0]), rgba=RED)

    for geom in drawn(everything, offset=(0, 5, 0)):
        np.testing.assert_allclose(geom.pos, (0, 5, 0), atol=1e-6)


def test_what_does_not_fit_is_refused_not_dropped(recwarn):
    scene = empty_scene(capacity=2)
    visualizer = DebugVisualizer(MODEL, scene)
    visualizer.line((0, 0, 0), (1, 0, 0), rgba=RED)
    visualizer.ghost(np.array([0.0]), rgba=RED)
    for draw in (
        lambda: visualizer.sphere((0, 0, 0), radius=0.1, rgba=RED),
        lambda: visualizer.ghost(np.array([0.0]), rgba=RED),
    ):
        with pytest.raises(RuntimeError, match="the scene is full: 2 geoms"):
            draw()
    assert scene.ngeom == 2 and not recwarn.list


def test_moving_geoms_are_added_without_the_fixed_ones():
    ground = PUCK_XML.replace(
        "<worldbody>", '<worldbody><geom name="ground" type="plane" size="1 1 1"/>'
    )
    model = mujoco.MjModel.from_xml_string(ground)
    scene, data = mujoco.MjvScene(model, maxgeom=20), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    add_geoms(model, data, scene, np.array([0.0, 3.0, 0.0]))
    assert scene.ngeom == 1
    np.testing.assert_allclose(scene.geoms[0].pos, (0, 3, 0), atol=1e-6)


@pytest.mark.parametrize(("group", "shown"), [(0, 0), (2, 0), (3, 1)])
def test_a_robot_without_visual_geoms_is_drawn_by_its_collision_geoms(group, shown):
    xml = f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
    <body><freejoint/><geom size="0.1" group="{group}"/></body></worldbody></mujoco>"""
    assert visible_groups(mujoco.MjModel.from_xml_string(xml)).geomgroup[3] == shown
