"""Named quantities against MuJoCo's C engine at random states; writes, memory and draws."""

import math

import mujoco
import numpy as np
import pytest
import torch

from tests.envs.mdp.bench import FREE_BODY, Bench

E = 16
FREE, SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FIXED_BASE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body name="turret" pos="0.3 -0.2 0.7" quat="0.8 0.1 0.5 -0.3">
      <joint name="pan" axis="0.2 0.1 1" pos="0.05 0 0"/>
      <geom name="turret" type="box" size="0.1 0.2 0.3" pos="0.1 0 0.2" mass="1.5"/>
      <site name="eye" pos="0.2 0.1 0"/>
      <body name="wrist" pos="0 0.1 0.4">
        <joint name="ball" type="ball"/>
        <geom name="wrist" type="sphere" size="0.05" mass="0.4"/>
        <body name="rod" pos="0.1 0 0.1">
          <joint name="reach" type="slide" axis="1 1 0" range="-0.2 0.6" limited="true"/>
          <geom name="rod" type="capsule" size="0.02 0.2" mass="0.7" contype="0" conaffinity="0"/>
          <site name="tip" pos="0 0 0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="pan" joint="pan"/><motor name="reach" joint="reach"/></actuator>
  <sensor><gyro name="gyro" site="tip"/><framepos name="tip" objtype="site" objname="tip"/></sensor>
</mujoco>
"""
"""A turret whose ball joint stands between its hinge and its slide, so that their addresses are not contiguous."""


def random_bench(source: str) -> Bench:
    """Put worlds at random states, ball and free joints at random orientations."""
    bench = Bench(source, E, {}, soft_joint_pos_limit_factor=0.5)
    rng = np.random.default_rng(0)
    model = bench.world.mj_model
    qpos = rng.uniform(-0.2, 0.5, (E, model.nq))
    qvel = rng.normal(0.0, 1.5, (E, model.nv))
    for row in qpos:
        for joint in np.flatnonzero(model.jnt_type < SLIDE):
            start = model.jnt_qposadr[joint] + (3 if model.jnt_type[joint] == FREE else 0)
            turn = rng.normal(size=4)
            row[start : start + 4] = turn / np.linalg.norm(turn)
    bench.place(qpos, qvel)
    return bench


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


def engine_rows(bench):
    """Yield row number and the C engine's data for the same state."""
    model, data = bench.world.mj_model, mujoco.MjData(bench.world.mj_model)
    for row in range(E):
        data.qpos[:], data.qvel[:] = bench.world.qpos_EL[row].double(), bench.world.qvel_EL[row].double()
        mujoco.mj_forward(model, data)
        yield row, model, data


def engine(bench, read):
    """Return what `read(model, data)` gives in each row, float32 [E, ...]."""
    rows = [np.array(read(model, data)) for _, model, data in engine_rows(bench)]
    return torch.tensor(np.stack(rows), dtype=torch.float32)


def velocity(model, data, kind, ids, *, part):
    """Return world-frame velocities of frame origins, [N, 3], from `mj_objectVelocity`: (angular, linear)."""
    result, six = [], np.zeros(6)
    for i in ids:
        mujoco.mj_objectVelocity(model, data, kind, i, six, 0)
        result.append(six[:3].copy() if part == "angular" else six[3:].copy())
    return np.stack(result)


def close(actual, expected):
    torch.testing.assert_close(actual, expected, atol=2e-5, rtol=2e-5)


def scalar_joints(model):
    return np.flatnonzero(model.jnt_type >= SLIDE)


def test_joint_quantities(bench):
    close(bench.view.joint_pos_EL, engine(bench, lambda m, d: d.qpos[m.jnt_qposadr[scalar_joints(m)]]))
    close(bench.view.joint_vel_EL, engine(bench, lambda m, d: d.qvel[m.jnt_dofadr[scalar_joints(m)]]))
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
    close(bench.view.root_quat_EL * torch.sign((bench.view.root_quat_EL * quat).sum(-1, keepdim=True)), quat)
    close(
        bench.view.projected_gravity_EL,
        engine(bench, lambda m, d: d.xmat[root].reshape(3, 3).T @ [0.0, 0.0, -1.0]),
    )
    close(bench.view.heading_E, engine(bench, lambda m, d: math.atan2(d.xmat[root][3], d.xmat[root][0])))


@pytest.mark.parametrize("part", ["linear", "angular"])
def test_root_velocity_in_world_and_body_frame(bench, part):
    world_frame = engine(
        bench, lambda m, d: velocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, [1], part=part)[0]
    )
    body_frame = engine(
        bench,
        lambda m, d: d.xmat[1].reshape(3, 3).T
        @ velocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, [1], part=part)[0],
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
    bodies = [i for i in range(1, model.nbody)]
    index = view.bodies(".*(trunk|left|right|turret|wrist|rod)")
    kind = mujoco.mjtObj.mjOBJ_XBODY
    close(view.body_pos_w(index), engine(bench, lambda m, d: d.xpos[bodies]))
    close(
        view.body_lin_vel_w(index), engine(bench, lambda m, d: velocity(m, d, kind, bodies, part="linear"))
    )
    close(
        view.body_ang_vel_w(index), engine(bench, lambda m, d: velocity(m, d, kind, bodies, part="angular"))
    )


def test_names_give_their_own_order_and_scattered_bodies(free):
    index = free.view.bodies(("right", "trunk"))
    model = free.world.mj_model
    ids = [model.body("right").id, model.body("trunk").id]
    close(free.view.body_pos_w(index), engine(free, lambda m, d: d.xpos[ids]))
    close(
        free.view.body_lin_vel_w(index),
        engine(free, lambda m, d: velocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, ids, part="linear")),
    )


def test_site_positions_and_velocities(bench):
    view = bench.view
    sites = list(range(bench.world.mj_model.nsite))
    index = view.sites(".*")
    close(view.site_pos_w(index), engine(bench, lambda m, d: d.site_xpos[sites]))
    expected = engine(bench, lambda m, d: velocity(m, d, mujoco.mjtObj.mjOBJ_SITE, sites, part="linear"))
    close(view.site_lin_vel_w(index), expected)


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


# -- writes ------------------------------------------------------------------------------------------------------


def odd_rows():
    return torch.arange(E) % 2 == 1


def check_rows(mask_E, actual, before, expected):
    """Written rows hold `expected`, the others are bit-identical."""
    torch.testing.assert_close(actual[mask_E], expected.expand_as(actual)[mask_E])
    assert torch.equal(actual[~mask_E], before[~mask_E])


def test_writes_touch_masked_rows_only():
    bench = random_bench(FREE_BODY)
    view, world, mask_E = bench.view, bench.world, odd_rows()
    qpos, qvel = world.qpos_EL.clone(), world.qvel_EL.clone()
    new_qpos = torch.tensor([1.0, 2, 3, 0, 1, 0, 0, 0.1, 0.2]).expand(E, -1)
    view.write_qpos(mask_E, new_qpos)
    check_rows(mask_E, world.qpos_EL, qpos, new_qpos)
    view.write_qvel(mask_E, torch.arange(8.0).expand(E, -1))
    check_rows(mask_E, world.qvel_EL, qvel, torch.arange(8.0))
    view.write_root_pose(mask_E, torch.full((E, 3), 7.0), torch.tensor([0.0, 0, 1, 0]).expand(E, -1))
    check_rows(mask_E, world.qpos_EL, qpos, torch.tensor([7.0, 7, 7, 0, 0, 1, 0, 0.1, 0.2]))


def test_written_root_velocity_reads_back_in_the_world_frame():
    bench = random_bench(FREE_BODY)
    mask_E = odd_rows()
    lin, ang = torch.randn(E, 3), torch.randn(E, 3)
    before = bench.world.qvel_EL.clone()
    bench.view.write_root_velocity(mask_E, lin, ang)
    assert torch.equal(bench.world.qvel_EL[~mask_E], before[~mask_E])
    bench.refresh()
    kind = mujoco.mjtObj.mjOBJ_XBODY
    close(engine(bench, lambda m, d: velocity(m, d, kind, [1], part="linear")[0])[mask_E], lin[mask_E])
    close(engine(bench, lambda m, d: velocity(m, d, kind, [1], part="angular")[0])[mask_E], ang[mask_E])


@pytest.mark.parametrize("source", [FREE_BODY, FIXED_BASE], ids=["contiguous", "scattered"])
@pytest.mark.parametrize("order", ["all", "slice", "reversed"])
def test_joint_writes_by_slice_and_by_index(source, order):
    bench = random_bench(source)
    view, mask_E = bench.view, odd_rows()
    names = view.joint_names()
    chosen = {"all": names, "slice": names[1:], "reversed": names[::-1]}[order]
    index = slice(None) if order == "all" else view.joints(tuple(chosen))
    pos, vel = torch.rand(E, len(chosen)), torch.rand(E, len(chosen))
    before = {"qpos": bench.world.qpos_EL.clone(), "qvel": bench.world.qvel_EL.clone()}
    view.write_joint_pos(mask_E, pos, index)
    view.write_joint_vel(mask_E, vel, index)
    model = bench.world.mj_model
    for state, after, value, address in (
        ("qpos", bench.world.qpos_EL, pos, model.jnt_qposadr),
        ("qvel", bench.world.qvel_EL, vel, model.jnt_dofadr),
    ):
        expected = before[state].clone()
        for column, name in enumerate(chosen):
            expected[:, address[model.joint(name).id]] = value[:, column]
        expected[~mask_E] = before[state][~mask_E]
        assert torch.equal(after, expected), state


def test_a_derived_quantity_after_a_write_is_refused_until_the_refresh():
    bench = random_bench(FREE_BODY)
    view, everybody_E = bench.view, bench.everybody_E
    view.write_joint_pos(everybody_E, torch.zeros(E, 2))
    assert view.joint_pos_EL.eq(0).all(), "the joint state itself is never stale"
    assert torch.equal(view.root_lin_vel_w_EL, bench.world.qvel_EL[:, :3])
    with view.scope("events/push"):
        for read in (
            lambda: view.body_pos_w(slice(1, 2)),
            lambda: view.body_lin_vel_w(slice(1, 2)),
            lambda: view.body_ang_vel_w(slice(1, 2)),
            lambda: view.site_pos_w(slice(0, 1)),
            lambda: view.site_lin_vel_w(slice(0, 1)),
            lambda: view.sensor("gyro"),
        ):
            with pytest.raises(RuntimeError, match="events/push reads a derived quantity"):
                read()
    bench.refresh()
    assert view.body_pos_w(slice(1, 2)).shape == (E, 1, 3)


def test_a_fixed_roots_pose_after_a_write_is_refused():
    bench = random_bench(FIXED_BASE)
    assert bench.view.heading_E.shape == (E,)
    bench.view.write_joint_vel(bench.everybody_E, torch.zeros(E, 2))
    for name in ("root_pos_EL", "heading_E", "root_lin_vel_w_EL", "root_ang_vel_b_EL"):
        with pytest.raises(RuntimeError, match="derived"):
            getattr(bench.view, name)


# -- memory and draws --------------------------------------------------------------------------------------------


def test_memory_belongs_to_the_calling_term():
    view = Bench(FREE_BODY, E, {}).view
    with view.scope("rewards/a"):
        first = view.memory("peak", 2)
    with view.scope("rewards/b"):
        second = view.memory("peak", 3, dtype=torch.int64)
    with view.scope("rewards/a"):
        assert view.memory("peak", 2) is first
        with pytest.raises(ValueError, match=r"'rewards/a\.peak' is torch.float32 \(2,\), asked for"):
            view.memory("peak", 3)
    assert first.shape == (E, 2) and second.dtype == torch.int64


def test_rows_that_reset_forget_unless_told_to_keep():
    view, mask_E = Bench(FREE_BODY, E, {}).view, odd_rows()
    with view.scope("rewards/a"):
        forgets, keeps = view.memory("forgets", 2, 2), view.memory("keeps", keep=True)
    forgets.fill_(1.0), keeps.fill_(1.0)
    view.memories.clear(mask_E)
    assert keeps.eq(1.0).all() and forgets[mask_E].eq(0.0).all() and forgets[~mask_E].eq(1.0).all()


def test_memory_cannot_come_into_being_after_construction():
    view = Bench(FREE_BODY, E, {}).view
    with view.scope("rewards/a"):
        held = view.memory("held")
        held.fill_(1.0)
        view.freeze()
        assert view.memory("held") is held and held.eq(0.0).all()
        with pytest.raises(ValueError, match=r"'rewards/a\.late' is new after construction"):
            view.memory("late")


def drawn(view, scope, counter=None, *, times=1, draws="", normal=False):
    with view.scope(scope, counter, draws=draws):
        return [view.normal(3) if normal else view.uniform(3) for _ in range(times)]


def test_draws_are_a_function_of_seed_scope_moment_and_row():
    view = Bench(FREE_BODY, E, {}).view
    (first,) = drawn(view, "events/a")
    assert torch.equal(drawn(view, "events/a")[0], first), "the same moment, the same numbers"
    others = [
        drawn(view, "events/b")[0],
        drawn(view, "events/a", draws="reset")[0],
        drawn(view, "events/a", torch.ones((), dtype=torch.int64))[0],
        drawn(view, "events/a", times=2)[1],
    ]
    for other in others:
        assert not torch.isclose(other, first).any()
    view.seed.fill_(1)
    assert not torch.isclose(drawn(view, "events/a")[0], first).any()
    assert len(first.unique()) == first.numel(), "rows and columns draw apart"


def test_draws_advance_with_the_step_or_with_the_given_counter():
    view = Bench(FREE_BODY, E, {}).view
    before = drawn(view, "events/a", normal=True)[0]
    view.step_count.add_(1)
    assert not torch.isclose(drawn(view, "events/a", normal=True)[0], before).any()
    reset_before = drawn(view, "events/a", view.reset_count_E)[0]
    view.reset_count_E[3] += 1
    reset_after = drawn(view, "events/a", view.reset_count_E)[0]
    changed = (reset_after != reset_before).any(-1)
    assert changed.tolist() == [row == 3 for row in range(E)], "one row's reset changes its own numbers only"


def test_a_row_draws_the_same_numbers_among_few_and_many():
    few, many = Bench(FREE_BODY, 2, {}).view, Bench(FREE_BODY, E, {}).view
    assert torch.equal(drawn(few, "events/a")[0], drawn(many, "events/a")[0][:2])


def test_draws_keep_to_their_range():
    view = Bench(FREE_BODY, E, {}).view
    low, high = torch.tensor([0.0, -5.0]), torch.tensor([0.1, 5.0])
    with view.scope("events/a"):
        drawn_E2 = view.uniform(2, low, high)
    assert (drawn_E2 >= low).all() and (drawn_E2 < high).all() and drawn_E2[:, 1].std() > 1.0


def test_what_observations_return_shares_no_memory_with_the_state():
    view = Bench(FREE_BODY, E, {}).view
    view.freeze()
    computed = view.projected_gravity_EL
    assert view.detached(computed) is computed
    aliased = view.joint_pos_EL
    assert view.detached(aliased).data_ptr() != aliased.data_ptr()
