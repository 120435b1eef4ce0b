"""Named quantities against MuJoCo's C engine at random states."""

import math

import pytest
import torch

from tests.envs.random_states import (
    FIXED_BASE,
    SITE,
    E,
    close,
    engine,
    random_bench,
    scalar_joints,
    velocity,
)
from tests.mdp.bench import FREE_BODY


@pytest.fixture(scope="module")
def free():
    return random_bench(FREE_BODY)


@pytest.fixture(scope="module")
def fixed():
    return random_bench(FIXED_BASE)


@pytest.fixture(params=["free", "fixed"])
def bench(request):
    """Each model in turn, for tests that only read."""
    return request.getfixturevalue(request.param)


def test_joint_quantities(bench):
    close(
        bench.view.joint_pos_EL, engine(bench, lambda m, d: d.qpos[m.jnt_qposadr[scalar_joints(m)]])
    )
    close(
        bench.view.joint_vel_EL, engine(bench, lambda m, d: d.qvel[m.jnt_dofadr[scalar_joints(m)]])
    )
    close(bench.view.joint_pos_rel_EL, bench.view.joint_pos_EL - bench.view.default_joint_pos_EL)


def test_joint_acceleration_is_that_of_the_last_substep():
    bench = random_bench(FIXED_BASE)
    expected = engine(bench, lambda m, d: d.qacc[m.jnt_dofadr[scalar_joints(m)]])
    bench.world.step(1)
    bench.refresh()
    actual = bench.view.joint_acc_EL
    torch.testing.assert_close(actual, expected, atol=1e-3 * float(expected.abs().max()), rtol=1e-3)


def test_root_pose(bench):
    root = 1
    close(bench.view.root_pos_EL, engine(bench, lambda m, d: d.xpos[root]))
    quat = engine(bench, lambda m, d: d.xquat[root])
    close(
        bench.view.root_quat_EL
        * torch.sign((bench.view.root_quat_EL * quat).sum(-1, keepdim=True)),
        quat,
    )
    close(
        bench.view.projected_gravity_EL,
        engine(bench, lambda m, d: d.xmat[root].reshape(3, 3).T @ [0.0, 0.0, -1.0]),
    )
    close(
        bench.view.heading_E,
        engine(bench, lambda m, d: math.atan2(d.xmat[root][3], d.xmat[root][0])),
    )


@pytest.mark.parametrize("part", ["linear", "angular"])
def test_root_velocity_in_world_and_body_frame(bench, part):
    world_frame = engine(bench, lambda m, d: velocity(m, d, [1], part=part)[0])
    body_frame = engine(
        bench,
        lambda m, d: d.xmat[1].reshape(3, 3).T @ velocity(m, d, [1], part=part)[0],
    )
    view = bench.view
    ours = {
        "linear": (view.root_lin_vel_w_EL, view.root_lin_vel_b_EL),
        "angular": (view.root_ang_vel_w_EL, view.root_ang_vel_b_EL),
    }[part]
    close(ours[0], world_frame)
    close(ours[1], body_frame)


def test_body_poses_and_velocities(bench):
    view, model = bench.view, bench.world.mj_model
    bodies = list(range(1, model.nbody))
    named = view.bodies(".*(trunk|left|right|turret|wrist|rod)")
    close(named.pos_EN3, engine(bench, lambda m, d: d.xpos[bodies]))
    close(named.lin_vel_EN3, engine(bench, lambda m, d: velocity(m, d, bodies, part="linear")))
    close(named.ang_vel_EN3, engine(bench, lambda m, d: velocity(m, d, bodies, part="angular")))


def test_names_give_their_own_order_and_scattered_bodies(free):
    named = free.view.bodies(("right", "trunk"))
    model = free.world.mj_model
    ids = [model.body("right").id, model.body("trunk").id]
    close(named.pos_EN3, engine(free, lambda m, d: d.xpos[ids]))
    close(
        named.lin_vel_EN3,
        engine(free, lambda m, d: velocity(m, d, ids, part="linear")),
    )


def test_site_positions_and_velocities(bench):
    view = bench.view
    sites = list(range(bench.world.mj_model.nsite))
    named = view.sites(".*")
    close(named.pos_EN3, engine(bench, lambda m, d: d.site_xpos[sites]))
    expected = engine(bench, lambda m, d: velocity(m, d, sites, part="linear", kind=SITE))
    close(named.lin_vel_EN3, expected)


def test_sensors_by_name(bench):
    for i in range(bench.world.mj_model.nsensor):
        name = bench.world.mj_model.sensor(i).name
        close(bench.view.sensor(name), engine(bench, lambda m, d, name=name: d.sensor(name).data))


def test_unknown_names_list_the_near_ones(free):
    with pytest.raises(ValueError, match="no sensor 'gyr': did you mean 'gyro'"):
        free.view.sensor("gyr")
    with pytest.raises(ValueError, match=r"no command 'twist' in commands: there is none"):
        free.view.command("twist")
    with pytest.raises(ValueError, match=r"no contact sensor 'feet' in scene\.sensors"):
        free.view.contact("feet")


def test_soft_limits_shrink_ranges_about_their_middles(free, fixed):
    # Ranges (-1, 1) and (0, 2), factor 0.5; a joint without limits has infinite ones.
    assert free.view.soft_joint_pos_limits_L2.tolist() == [[-0.5, 0.5], [0.5, 1.5]]
    limits = fixed.view.soft_joint_pos_limits_L2
    assert limits[0].tolist() == [-math.inf, math.inf]
    torch.testing.assert_close(limits[1], torch.tensor([0.0, 0.4]))


def test_the_default_pose_is_the_first_keyframe_or_qpos0(free, fixed):
    assert free.view.default_joint_pos_EL.tolist() == [[0.25, 0.5]] * E
    assert free.view.default_qpos_L[:3].tolist() == [1.0, 2.0, 3.0]
    assert fixed.view.default_joint_pos_EL.tolist() == [[0.0, 0.0]] * E


def test_a_quantity_is_computed_once_between_two_changes(free):
    assert free.view.projected_gravity_EL is free.view.projected_gravity_EL
    before = free.view.projected_gravity_EL
    free.refresh()
    assert free.view.projected_gravity_EL is not before
