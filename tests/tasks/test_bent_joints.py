"""Robots that are dropped begin with their limbs apart, by MuJoCo's own contacts."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl import envs, mdp
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.tasks.bent_joints import BendJointsApart
from tests.absent_models import skipped_without_models

DEEP = 0.01


def starts_of(name, num_envs, **events):
    """Return the model of a task, and qpos of the first states of its envs."""
    cfg = envs.task(name).cfg()
    cfg = dataclasses.replace(
        cfg,
        seed=5,
        scene=dataclasses.replace(cfg.scene, num_envs=num_envs),
        sim=dataclasses.replace(cfg.sim, engine="c"),
        events={**cfg.events, **events},
    )
    env = envs.build(cfg, device=torch.device("cpu"))
    base = part(env, ManagerBasedRlEnv)
    env.reset()
    return base.world.mj_model, base.world.qpos_EL.double().numpy().copy()


def share_of_deep(mj_model, qpos_EL):
    """Return the share of states with a contact deeper than 1 cm, also with the ground."""
    data = mujoco.MjData(mj_model)
    deep = 0
    for qpos_L in qpos_EL:
        data.qpos[:] = qpos_L
        mujoco.mj_forward(mj_model, data)
        deep += bool((data.contact.dist < -DEEP).any())
    return deep / len(qpos_EL)


def test_a_humanoid_of_ours_begins_apart_in_poses_that_differ():
    bent = {"bend": mdp.ResetJoints(position_range=(-0.6, 0.6))}
    mj_model, qpos_EL = starts_of("humanoid_get_up", 100, **bent)
    assert share_of_deep(mj_model, qpos_EL) > 0.2
    apart = {"bend": BendJointsApart(position_range=(-0.6, 0.6), size=60)}
    mj_model, qpos_EL = starts_of("humanoid_get_up", 100, **apart)
    assert share_of_deep(mj_model, qpos_EL) == 0.0
    # Of a hundred draws from sixty poses about 49 differ; all joints bend, in both directions.
    different = np.unique(qpos_EL[:, 7:], axis=0)
    assert 35 <= len(different) <= 60
    assert (different.min(0) < different.max(0) - 0.5).all()
    assert np.ptp(different, axis=0).max() <= 1.2 + 1e-6


def test_a_range_in_which_limbs_are_never_apart_is_refused(monkeypatch):
    monkeypatch.setattr("ksim_rl.tasks.bent_joints.MOST_DRAWS", 5)
    monkeypatch.setattr("ksim_rl.tasks.bent_joints.reach_of", lambda *_: 0.02)
    apart = {"bend": BendJointsApart(position_range=(-0.1, 0.1), size=1)}
    with pytest.raises(ValueError, match="in 5 draws the limbs reach into each other by more"):
        starts_of("humanoid_get_up", 1, **apart)


@pytest.mark.full
@pytest.mark.parametrize("name", ["go1_get_up", "g1_get_up", "t1_get_up"])
def test_robots_of_the_menagerie_begin_apart(name):
    with skipped_without_models():
        mj_model, qpos_EL = starts_of(name, 500)
    assert share_of_deep(mj_model, qpos_EL) == 0.0
