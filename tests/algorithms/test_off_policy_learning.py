"""SAC, FastSAC and FastTD3 swing a pendulum up."""

import pytest
import torch

from ksim_rl import conf
from ksim_rl.collectors import RolloutCollector
from ksim_rl.objectives import SACCfg, TD3Cfg
from ksim_rl.trainers import Evaluator, build
from tests.algorithms.off_policy_problem import make_update
from tests.algorithms.pendulum_env import LENGTH, SOLVED_AT, PendulumEnv

SHARED = {"gamma": 0.97, "tau": 0.02, "critic_learning_rate": 1e-3, "actor_learning_rate": 1e-3}
OBJECTIVES = {
    "sac": SACCfg(alpha_init=1.0, alpha_learning_rate=1e-3, **SHARED),
    "fast_sac": SACCfg(
        alpha_init=1.0, alpha_learning_rate=1e-3, value_reduction="mean", policy_delay=2, **SHARED
    ),
    "fast_td3": TD3Cfg(
        exploration_noise_min=0.05, exploration_noise_max=0.5, target_noise=0.1, **SHARED
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("name", list(OBJECTIVES))
def test_swings_a_pendulum_up(name):
    torch.manual_seed(0)
    env = PendulumEnv(32)
    update = make_update(
        name,
        env,
        objective=OBJECTIVES[name],
        obs_dim=3,
        support=(-300.0, 0.0),
        num_env_states_per_minibatch=256,
        num_steps=4,
        num_minibatches=8,
        capacity=2000,
        learning_starts=40,
    )
    collector = RolloutCollector(env, update.behavior, rollout_length=4, keys=update.rollout_keys)
    evaluator = Evaluator(PendulumEnv(20), update.actor, max_steps=LENGTH, seed=7)
    best = -float("inf")
    for iteration in range(1, 601):
        update(collector.collect())
        if iteration % 100 == 0:
            best = max(best, evaluator().return_mean)
            if best > SOLVED_AT:
                break
    assert best > SOLVED_AT


@pytest.mark.full
def test_a_task_is_solved():
    overrides = ["task=pendulum_swingup", "objective=fast_td3", "device=cpu", "logger=none"]
    outcome = build(conf.compose([*overrides, "trainer.eval_episodes=20"])).train()
    assert outcome.solved, outcome
