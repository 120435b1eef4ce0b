"""The walking clip: what is shipped is what the script computes, and MuJoCo's C engine finds a walk in it."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.motions import motion_path
from ksim_rl.scene.robots.control_models import Walker
from tests.scene.motions import walker_walk


@pytest.fixture(scope="module")
def clip():
    with np.load(motion_path("walker_walk")) as archive:
        return dict(archive)


@pytest.fixture(scope="module")
def model():
    return Walker().spec().compile()


def test_the_shipped_clip_is_the_computed_one(clip):
    computed = walker_walk.walk()
    assert clip.keys() == computed.keys()
    for name, array in computed.items():
        if array.dtype.kind == "f":
            np.testing.assert_allclose(clip[name], array, atol=1e-5)
        else:
            assert clip[name].tolist() == array.tolist()


def test_joints_stay_in_their_limits(clip, model):
    for joint in np.flatnonzero(model.jnt_limited):
        low, high = model.jnt_range[joint]
        angle = clip["qpos"][:, model.jnt_qposadr[joint]]
        assert low < angle.min() and angle.max() < high, model.joint(joint).name


def test_velocities_are_those_of_the_positions(clip, model):
    difference = np.zeros(model.nv)
    for frame in range(1, len(clip["qpos"]) - 1):
        before, after = clip["qpos"][frame - 1].astype(float), clip["qpos"][frame + 1].astype(float)
        mujoco.mj_differentiatePos(model, difference, 2.0 / float(clip["fps"]), before, after)
        np.testing.assert_allclose(clip["qvel"][frame], difference, atol=2e-3)


def test_feet_stand_on_the_ground_and_take_turns(clip, model):
    data = mujoco.MjData(model)
    heights, velocities = [], []
    for qpos, qvel in zip(clip["qpos"], clip["qvel"], strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        row, speed = [], np.zeros(6)
        for side in ("right", "left"):
            foot = model.geom(f"{side}_foot").id
            end = data.geom_xmat[foot].reshape(3, 3)[2, 2] * model.geom_size[foot, 1]
            row.append(data.geom_xpos[foot, 2] - abs(end) - model.geom_size[foot, 0])
            mujoco.mj_objectVelocity(
                model, data, mujoco.mjtObj.mjOBJ_BODY, model.geom_bodyid[foot], speed, 0
            )
            velocities.append(speed[3])
        heights.append(row)
    heights = np.array(heights)
    velocities = np.array(velocities).reshape(-1, 2)
    stands = heights < 0.002
    assert heights.min() > 0.0, "no foot in the ground"
    assert (stands.sum(axis=1) >= 1).all(), "walking never leaves the ground"
    assert stands.mean(axis=0) == pytest.approx([0.6, 0.6], abs=0.05)
    # A foot that stands before and after a frame does not slide in it; the hips move at 0.8 m/s.
    rests = stands[1:-1] & stands[:-2] & stands[2:]
    assert np.abs(velocities[1:-1][rests]).max() < 0.02
    distance = clip["qpos"][-1, 0] - clip["qpos"][0, 0]
    assert distance == pytest.approx(0.8 * 8.0, abs=1e-3)


def test_other_files_keep_their_paths(tmp_path):
    own = tmp_path / "jump.npz"
    assert motion_path(str(own)) == own
    assert motion_path("no_such_motion").name == "no_such_motion"
