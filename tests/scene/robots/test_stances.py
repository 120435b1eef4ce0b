"""Every legged robot has what walking tasks read, and stands in its default pose without a policy."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go import UnitreeGo1, UnitreeGo2
from tests.scene.robots.standing import on_a_plane, stand, uprightness

# G1's reference gains are too soft to stand on for long without balancing: it tips over after a second.
SECONDS = {
    UnitreeGo1: 2.0,
    UnitreeGo2: 2.0,
    UnitreeG1: 0.7,
    BoosterT1: 2.0,
    Quadruped: 2.0,
    Humanoid: 2.0,
}


@pytest.fixture(scope="module", params=SECONDS, ids=lambda robot: robot.name)
def robot(request):
    return request.param()


@pytest.fixture(scope="module")
def model(robot):
    return on_a_plane(robot)


def test_stands(robot, model):
    data = stand(robot, model, seconds=SECONDS[type(robot)])
    assert uprightness(data, robot.root_body) > 0.98
    assert data.qpos[2] > 0.75 * model.key_qpos[0, 2]
    assert np.abs(data.qpos[:2]).max() < 0.15
    assert np.abs(data.actuator_force).max() < 15.0  # N m
    touching = {model.geom(int(i)).name for i in data.contact.geom.ravel()} - {"terrain"}
    assert touching and touching <= set(robot.foot_geoms)


def test_default_pose_is_on_the_ground_and_touches_nothing_else(robot, model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    soles = [data.geom(name).xpos[2] - model.geom(name).size[0] for name in robot.foot_geoms]
    assert np.abs(soles).max() < 0.02
    touching = {model.geom(int(i)).name for i in data.contact.geom.ravel()} - {"terrain"}
    assert touching <= set(robot.foot_geoms)


def test_facts_name_what_the_model_has(robot, model):
    hinges = [
        model.joint(i).name
        for i in range(model.njnt)
        if model.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE
    ]
    assert sorted(robot.joint_names) == sorted(hinges)
    assert sorted(model.actuator(i).name for i in range(model.nu)) == sorted(hinges)
    assert model.body(robot.root_body).id == model.jnt_bodyid[0]
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    assert all(data.site(site).xpos[2] < 0.05 for site in robot.foot_sites)
    for sensor in ("imu_lin_vel", "imu_ang_vel", "root_angmom"):
        assert model.sensor(sensor).dim[0] == 3


def test_default_pose_is_inside_the_soft_limits(robot, model):
    low, high = model.jnt_range[1:].T
    middle, half = (low + high) / 2, (high - low) / 2 * robot.soft_joint_pos_limit_factor
    assert (np.abs(model.key_qpos[0, 7:] - middle) < half).all()


def test_what_collides_is_few_and_cheap(model):
    colliding = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    kinds = [mujoco.mjtGeom(int(kind)) for kind in model.geom_type[colliding]]
    cheap = (
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_PLANE,
    )
    assert sum(kind not in cheap for kind in kinds) <= 1 and len(colliding) <= 34
