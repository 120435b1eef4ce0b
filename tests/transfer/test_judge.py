"""A policy is judged as an evaluation judges it, and conditions reach the worlds."""

import dataclasses

import pytest
import torch

from ksim_rl.envs import ManagerBasedRlEnv
from ksim_rl.envs.contract import part
from ksim_rl.scene.scene import build_spec
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.build import build_evaluator
from ksim_rl.trainers.other_physics import in_c_engine
from ksim_rl.trainers.run_folder import policy_of
from ksim_rl.transfer.conditions import CONDITIONS
from ksim_rl.transfer.judge import judge
from ksim_rl.zoo.cards import FOLDER

BY_NAME = {condition.name: condition for condition in CONDITIONS}


@pytest.fixture(scope="module")
def policy():
    return policy_of(checkpoint.load_latest(FOLDER / "quadruped"), device="cpu")


@pytest.mark.full
def test_as_trained_is_an_evaluation_on_the_c_engine(policy):
    found = judge(policy.cfg, policy.actor, CONDITIONS[0], episodes=4, seconds=1.0)
    task = dataclasses.replace(policy.cfg.task, sim=in_c_engine(policy.cfg.task.sim))
    evaluator = build_evaluator(
        dataclasses.replace(policy.cfg, task=task), policy.actor, episodes=4
    )
    # Of 20 ms each.
    evaluator.max_steps = 50
    assert found.return_mean == pytest.approx(evaluator().return_mean)
    assert 0.0 < found.effort <= 1.0 and found.speed > 0.5 and found.power > 1.0
    assert found.impact > 0.0 and set(found.errors) == {
        "linear_velocity_error",
        "angular_velocity_error",
    }


@pytest.mark.full
def test_limits_of_effort_reach_the_worlds(policy):
    # A good policy may need no more than what is left of them: returns would tell nothing.
    weak = BY_NAME["a battery that is empty"].change(policy.cfg.task)
    weak = dataclasses.replace(weak, sim=in_c_engine(weak.sim))
    cfg = dataclasses.replace(policy.cfg, task=weak, device="cpu")
    env = build_evaluator(cfg, policy.actor, episodes=2).env
    env.reset()
    base = part(env, ManagerBasedRlEnv)
    range_EL2 = base.view.field("actuator_forcerange")
    of_file_L2 = torch.from_numpy(build_spec(cfg.task.scene).compile().actuator_forcerange).float()
    torch.testing.assert_close(range_EL2, (0.7 * of_file_L2).expand_as(range_EL2))
