"""Starts are drawn by dm_control's rules: in their ranges, without contacts, settled, and for reset rows only."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs
from ksim_rl.scene.scene import build_spec
from ksim_rl.suites.dm_control import DmControlModel, StartFromBank
from ksim_rl.suites.dm_control.tasks import make_cfg
from tests.suites.dm_control_truth import load

pytest.importorskip("dm_control")


def bank_of(name, **changes):
    """The model of a task and its bank of starts, without an env."""
    cfg = make_cfg(name, "dm_control")
    mj_model = build_spec(cfg.scene).compile()
    rule = dataclasses.replace(cfg.events["start"], **changes)
    return mj_model, rule.draw(mj_model, mj_model.qpos0.copy())


def contacts(mj_model, qpos_NL):
    data, found = mujoco.MjData(mj_model), []
    for qpos_L in qpos_NL:
        data.qpos[:] = qpos_L
        mujoco.mj_forward(mj_model, data)
        found.append(data.ncon)
    return np.array(found)


@pytest.mark.parametrize("name", ["ball_in_cup_catch", "finger_spin", "humanoid_stand"])
def test_nothing_touches_in_a_bank_where_contacts_are_refused(name):
    mj_model, bank_NL = bank_of(name)
    assert bank_NL.shape == (4096, mj_model.nq + mj_model.nv)
    assert not contacts(mj_model, bank_NL[::8, : mj_model.nq]).any()
    _, with_contacts_NL = bank_of(name, without_contacts=False)
    assert contacts(mj_model, with_contacts_NL[::8, : mj_model.nq]).any()


@pytest.mark.parametrize(
    "name",
    ["ball_in_cup_catch", "finger_spin", pytest.param("humanoid_stand", marks=pytest.mark.full)],
)
def test_a_bank_has_the_spread_of_dm_controls_own_starts(name):
    mj_model, bank_NL = bank_of(name)
    theirs = load(*(("ball_in_cup", "catch") if "ball" in name else name.split("_")))
    rows = []
    for _ in range(400):
        theirs.reset()
        rows.append(theirs.physics.data.qpos.copy())
    theirs_NL, ours_NL = np.stack(rows), bank_NL[:, : mj_model.nq]
    spread_L = theirs_NL.std(axis=0)
    np.testing.assert_allclose(ours_NL.std(axis=0), spread_L, rtol=0.2, atol=1e-9)
    # Six standard errors of the mean of 400.
    assert (np.abs(ours_NL.mean(axis=0) - theirs_NL.mean(axis=0)) <= 0.3 * spread_L + 1e-9).all()


@pytest.mark.full
def test_a_bank_of_cheetahs_has_settled_as_c_settles_them():
    mj_model, drawn_NL = bank_of("cheetah_run", settle_steps=0)
    _, bank_NL = bank_of("cheetah_run")
    data = mujoco.MjData(mj_model)
    data.qpos[:] = drawn_NL[17, : mj_model.nq]
    mujoco.mj_step(mj_model, data, nstep=200)
    np.testing.assert_allclose(bank_NL[17], np.concatenate((data.qpos, data.qvel)), atol=1e-9)
    assert (np.abs(bank_NL[:, mj_model.nq :]).mean() < 0.1) and (
        drawn_NL[:, mj_model.nq :] == 0.0
    ).all()


def test_a_small_bank_is_refused():
    with pytest.raises(ValueError, match="size=100"):
        StartFromBank(size=100)


def test_starts_lie_in_the_ranges_and_only_rows_that_reset_start():
    env = envs.make("dm_control_cartpole_balance", num_envs=256, seed=3)
    world = env.base_env.world
    env.reset()
    first_EL = world.qpos_EL.clone()
    assert (first_EL[:, 0].abs() <= 0.1).all() and (first_EL[:, 1].abs() <= 0.034).all()
    assert first_EL[:, 0].std() > 0.04 and world.qvel_EL.std() == pytest.approx(0.01, rel=0.2)
    env.reset(env_ids=torch.arange(10))
    assert torch.equal(world.qpos_EL[10:], first_EL[10:])
    assert not torch.isclose(world.qpos_EL[:10], first_EL[:10]).any(dim=-1).all()
    env.close()


def test_the_variants_of_the_pendulum_start_over_all_angles_and_over_half():
    angles = {}
    for variant in ("dm_control", "playground"):
        env = envs.make(f"{variant}_pendulum_swingup", num_envs=256, seed=3)
        env.reset()
        angles[variant] = env.base_env.world.qpos_EL[:, 0]
        assert env.base_env.step_dt == pytest.approx(0.02)
        env.close()
    assert angles["dm_control"].min() < -2.5 and angles["dm_control"].max() > 2.5
    assert angles["playground"].min() >= 0.0 and angles["playground"].max() > 2.5


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("ksim_rl.suites.foreign_models.find_spec", lambda name: None)
    assert "dm_control_humanoid_walk" in envs.names()
    with pytest.raises(ValueError, match=r"pip install 'ksim_rl\[dm_control\]'"):
        DmControlModel(domain="humanoid").spec()
