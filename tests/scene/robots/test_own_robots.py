"""The robots of the repository: nothing to download, masses that make sense, left and right mirror each other."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from tests.scene.robots.standing import on_a_plane, stand, uprightness

MASS = {Quadruped: (11.0, 14.0), Humanoid: (17.0, 20.0)}
MIRROR = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module", params=MASS, ids=lambda robot: robot.name)
def robot(request):
    return request.param()


@pytest.fixture(scope="module")
def model(robot):
    return on_a_plane(robot)


def swapped(name):
    return name.replace("left", "?").replace("right", "left").replace("?", "right")


def mirror_of_joints(model):
    """Return for each hinge the address of its mirror image in qpos and the sign of the angle, from names and axes."""
    addresses, signs = [], []
    for index in range(1, model.njnt):
        # A rotation axis is a pseudovector: mirroring y keeps its y component and flips the others.
        signs.append(1.0 if abs(model.jnt_axis[index, 1]) == 1.0 else -1.0)
        addresses.append(int(model.joint(swapped(model.joint(index).name)).qposadr[0]))
    return np.array(addresses), np.array(signs)


def mirrored(model, qpos):
    addresses, signs = mirror_of_joints(model)
    return np.concatenate((qpos[:3] * MIRROR, qpos[3:7] * [1, -1, 1, -1], signs * qpos[addresses]))


def test_masses_are_plausible(robot, model):
    low, high = MASS[type(robot)]
    assert low < model.body_subtreemass[1] < high
    links = model.body_mass[model.body_rootid == 1]
    assert links.min() > 0.05 and links.max() < 0.6 * links.sum()
    # The weight rests on the shells: hulls have none.
    hulls = (model.geom_contype | model.geom_conaffinity) != 0
    assert set(model.geom_group[hulls]) == {0, 3} and set(model.geom_group[~hulls]) == {2}


def test_mirrored_start_gives_the_mirrored_motion(robot, model):
    """The C engine itself says whether the model is symmetric: geometry, masses, ranges, gains, contacts."""
    rng = np.random.default_rng(0)
    data, image = mujoco.MjData(model), mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[3:7] = [0.99, 0.08, -0.05, 0.1]
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qpos[2] += 0.05
    data.qpos[7:] += rng.uniform(-0.15, 0.15, model.nu)
    image.qpos[:] = mirrored(model, data.qpos)
    mujoco.mj_forward(model, data)
    mujoco.mj_forward(model, image)
    for _ in range(60):
        for one in (data, image):
            one.ctrl[:] = model.key_ctrl[0]
            mujoco.mj_step(model, one)
    np.testing.assert_allclose(image.qpos, mirrored(model, data.qpos), atol=2e-3)
    assert np.abs(data.qpos[1]) > 1e-3  # it did move sideways


def test_survives_a_push_and_a_fall(robot, model):
    data = stand(robot, model, seconds=1.0)
    data.qvel[:2] += [0.15, 0.1]
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert uprightness(data, robot.root_body) > 0.95
    for turn in ([0.0, 1.0, 0.0, 0.0], [0.7071, 0.7071, 0.0, 0.0], [0.7071, 0.0, 0.7071, 0.0]):
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.qpos[2] += 0.15
        data.qpos[3:7] = turn
        for _ in range(400):
            mujoco.mj_step(model, data)
        assert np.isfinite(data.qpos).all() and not data.warning.number.any()
        # It lies on the ground, neither in it nor above it, and rests.
        assert 0.03 < data.qpos[2] < 0.3 and np.abs(data.qvel).max() < 1.0
