import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, capacity
from tests.physics.models import cartpole, quadruped


def test_probed_capacities_hold_for_robots_thrown_about():
    mj_model = quadruped()
    rng = np.random.default_rng(7)
    world = World(mj_model, num_envs=64)
    world.qpos_EL.copy_(torch.from_numpy(capacity.random_qpos(mj_model, 64, rng)))
    world.qpos_EL[:, 2] = 0.25
    for _ in range(20):
        world.ctrl_EL.uniform_(-1.0, 1.0)
        world.step(4)
    report = world.overflow_report()
    assert report.ok, report.messages
    assert report.ncon > 64


def test_candidate_pairs_cover_warps_broadphase():
    mj_model = quadruped()
    rng = np.random.default_rng(3)
    pairs = capacity.CandidatePairs(mj_model)
    world = World(mj_model, num_envs=1, sim=SimCfg(njmax=200, nconmax=100))
    mj_data = mujoco.MjData(mj_model)
    for qpos in capacity.random_qpos(mj_model, 20, rng):
        mj_data.qpos[:] = qpos
        capacity.put_in_ground(mj_model, mj_data, depth=0.01)
        mujoco.mj_fwdPosition(mj_model, mj_data)
        world.qpos_EL[0] = torch.from_numpy(mj_data.qpos)
        world.qvel_EL.zero_()
        world.step(1)
        assert world.last_substep("ncollision").item() <= pairs.count(mj_data)
        assert world.last_substep("nacon").item() >= mj_data.ncon > 0


def test_a_model_without_contacts_gets_a_small_room():
    njmax, nconmax = capacity.probe(cartpole())
    assert njmax == nconmax == 8


def test_the_settings_win_over_the_probe():
    assert capacity.capacities(quadruped(), SimCfg(njmax=33, nconmax=11)) == (33, 11)
    njmax, nconmax = capacity.capacities(quadruped(), SimCfg(nconmax=11))
    assert (njmax, nconmax) == (capacity.probe(quadruped())[0], 11)


def test_put_in_ground_lets_the_lowest_geom_touch():
    mj_model = quadruped()
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[2] = 3.0
    capacity.put_in_ground(mj_model, mj_data, depth=0.005)
    mujoco.mj_forward(mj_model, mj_data)
    assert min(contact.dist for contact in mj_data.contact) == pytest.approx(-0.005, abs=1e-6)
