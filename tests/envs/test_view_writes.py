"""Writes through the view: masked rows only, and nothing stale is read afterwards."""

import pytest
import torch

from tests.envs.random_states import FIXED_BASE, E, close, engine, random_bench, velocity
from tests.mdp.bench import FREE_BODY


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
    view.write_root_pose(
        mask_E, torch.full((E, 3), 7.0), torch.tensor([0.0, 0, 1, 0]).expand(E, -1)
    )
    check_rows(mask_E, world.qpos_EL, qpos, torch.tensor([7.0, 7, 7, 0, 0, 1, 0, 0.1, 0.2]))


def test_written_root_velocity_reads_back_in_the_world_frame():
    bench = random_bench(FREE_BODY)
    mask_E = odd_rows()
    lin, ang = torch.randn(E, 3), torch.randn(E, 3)
    before = bench.world.qvel_EL.clone()
    bench.view.write_root_velocity(mask_E, lin, ang)
    assert torch.equal(bench.world.qvel_EL[~mask_E], before[~mask_E])
    bench.refresh()
    close(engine(bench, lambda m, d: velocity(m, d, [1], part="linear")[0])[mask_E], lin[mask_E])
    close(engine(bench, lambda m, d: velocity(m, d, [1], part="angular")[0])[mask_E], ang[mask_E])


@pytest.mark.parametrize("source", [FREE_BODY, FIXED_BASE], ids=["contiguous", "scattered"])
@pytest.mark.parametrize("order", ["all", "slice", "reversed"])
def test_joint_writes_by_slice_and_by_index(source, order):
    bench = random_bench(source)
    view, mask_E = bench.view, odd_rows()
    names = view.joints().names
    chosen = {"all": names, "slice": names[1:], "reversed": names[::-1]}[order]
    joints = view.joints() if order == "all" else view.joints(tuple(chosen))
    pos, vel = torch.rand(E, len(chosen)), torch.rand(E, len(chosen))
    before = {"qpos": bench.world.qpos_EL.clone(), "qvel": bench.world.qvel_EL.clone()}
    joints.write_pos(mask_E, pos)
    joints.write_vel(mask_E, vel)
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
    view.joints().write_pos(everybody_E, torch.zeros(E, 2))
    assert view.joint_pos_EL.eq(0).all(), "the joint state itself is never stale"
    assert torch.equal(view.root_lin_vel_w_EL, bench.world.qvel_EL[:, :3])
    with bench.driver.scope("events/push"):
        for read in (
            lambda: view.bodies("trunk").pos_EN3,
            lambda: view.bodies("trunk").lin_vel_EN3,
            lambda: view.bodies("trunk").ang_vel_EN3,
            lambda: view.sites(".*").pos_EN3,
            lambda: view.sites(".*").lin_vel_EN3,
            lambda: view.sensor("gyro"),
        ):
            with pytest.raises(RuntimeError, match="events/push reads a derived quantity"):
                read()
    bench.refresh()
    assert view.bodies("trunk").pos_EN3.shape == (E, 1, 3)


def test_a_fixed_roots_pose_after_a_write_is_refused():
    bench = random_bench(FIXED_BASE)
    assert bench.view.heading_E.shape == (E,)
    bench.view.joints().write_vel(bench.everybody_E, torch.zeros(E, 2))
    for name in ("root_pos_EL", "heading_E", "root_lin_vel_w_EL", "root_ang_vel_b_EL"):
        with pytest.raises(RuntimeError, match="derived"):
            getattr(bench.view, name)
