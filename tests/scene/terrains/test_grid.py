"""The grid of patches: which kind and difficulty is where, and what MuJoCo makes of it."""

import dataclasses

import mujoco
import numpy as np
import pytest

from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.envs import SceneCfg
from ksim_rl.scene.scene import MjcfRobot, build_spec
from ksim_rl.scene.terrains import (
    FlatPatch,
    PyramidSlope,
    PyramidStairs,
    RoughGround,
    TerrainGrid,
)
from tests.scene.terrains.ground_bench import GRID, THINGS


@pytest.fixture(scope="module")
def mj_model():
    spec = mujoco.MjSpec.from_string(THINGS)
    GRID.add_to(spec)
    return spec.compile()


def test_columns_follow_the_proportions_and_no_kind_is_left_out():
    patches = {
        "a": FlatPatch(proportion=6),
        "b": PyramidSlope(proportion=3),
        "c": RoughGround(proportion=0.001),
    }
    assert TerrainGrid(patches=patches, num_columns=3).columns == ("a", "b", "c")
    columns = TerrainGrid(patches=patches, num_columns=12).columns
    assert [columns.count(name) for name in "abc"] == [7, 4, 1] and columns == tuple(
        sorted(columns)
    )


def test_difficulty_rises_from_0_to_1():
    assert [GRID.difficulty(level) for level in range(3)] == [0.0, 0.5, 1.0]
    assert dataclasses.replace(GRID, num_levels=1).difficulty(0) == 1.0


def test_the_lowest_point_is_at_zero_and_steps_have_the_height_of_their_level():
    stairs = GRID.columns.index("stairs")
    low, high = PyramidStairs().step_height
    for level in range(3):
        heights_RC = GRID.heights(level, stairs)
        assert heights_RC.min() == 0.0
        steps = np.diff(np.unique(heights_RC.round(9)))
        assert np.allclose(steps, low + (high - low) * level / 2)


def test_ground_depends_on_its_seed_alone_and_columns_of_a_kind_differ():
    two = TerrainGrid(patches={"rough": RoughGround()}, num_levels=2, num_columns=2, seed=5)
    assert np.array_equal(two.heights(1, 0), dataclasses.replace(two, num_columns=4).heights(1, 0))
    assert not np.array_equal(two.heights(1, 0), two.heights(1, 1))
    assert not np.array_equal(two.heights(1, 0), dataclasses.replace(two, seed=6).heights(1, 0))


def test_mujoco_has_each_patch_with_its_heights(mj_model):
    assert mj_model.nhfield == 15
    for number in range(15):
        expected = GRID.heights(*divmod(number, 5))
        rows, columns = int(mj_model.hfield_nrow[number]), int(mj_model.hfield_ncol[number])
        first = mj_model.hfield_adr[number]
        heights = (
            mj_model.hfield_data[first : first + rows * columns] * mj_model.hfield_size[number, 2]
        )
        assert np.allclose(heights.reshape(rows, columns), expected, atol=1e-6)
        assert np.allclose(mj_model.hfield_size[number, :2], 2.0)
    assert mj_model.body("terrain").id > 0 and mj_model.body("terrain").mass == 0.0
    assert mj_model.geom("terrain").type == mujoco.mjtGeom.mjGEOM_HFIELD


def test_friction_reaches_the_geom():
    spec = mujoco.MjSpec.from_string(THINGS)
    dataclasses.replace(GRID, friction=(0.7, 0.01, 0.002)).add_to(spec)
    assert np.allclose(spec.compile().geom("terrain").friction, (0.7, 0.01, 0.002))


def test_a_scene_with_a_grid_survives_the_round_trip_through_its_tree():
    scene = SceneCfg(robots={"ball": MjcfRobot(source=THINGS)}, terrain=GRID)
    assert from_tree(SceneCfg, to_tree(scene, SceneCfg)) == scene
    assert build_spec(scene).geom("terrain") is not None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("patches", {}),
        ("num_levels", 0),
        ("num_columns", 4),
        ("size", 0.0),
        ("max_initial_level", -1),
        ("spawn_width", 5.0),
        ("seed", -1),
        ("friction", (-1.0, 0.0, 0.0)),
    ],
)
def test_a_grid_that_cannot_be_is_refused_by_field(field, value):
    with pytest.raises(ValueError, match=field):
        dataclasses.replace(GRID, **{field: value})
