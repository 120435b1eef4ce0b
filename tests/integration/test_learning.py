"""Training runs of robots and pendulums: each must reach a return that no untrained policy comes near."""

import pytest

from ksim_rl import conf
from ksim_rl.trainers import build

SMALL = ("device=cpu", "logger=none", "trainer.eval_episodes=0")


def reward_after(task, iterations, *overrides):
    """Train, and return the mean reward per step of the last three rollouts."""
    trainer = build(
        conf.compose([f"task={task}", *overrides, f"trainer.num_iterations={iterations}"])
    )
    rewards = []
    for _ in range(iterations):
        rollout_ET = trainer.collector.collect()
        rewards.append(float(rollout_ET["next", "reward"].mean()))
        trainer.update(rollout_ET)
    return sum(rewards[-3:]) / 3


NETWORKS = ("modules.actor.hidden_dims=[64,64]", "modules.critic.hidden_dims=[64,64]")


@pytest.mark.full
def test_a_hopper_learns_to_get_up_and_stand():
    # 250 thousand env states give 0.29 per step. An untrained policy falls at once and then gets 0.03 at most.
    sizes = ("num_envs=64", "data.num_env_states_per_minibatch=1024", "data.num_minibatches=4")
    overrides = (*SMALL, *sizes, *NETWORKS, "objective.learning_rate=1e-3")
    assert reward_after("hopper_stand", 60, *overrides) > 0.15


@pytest.mark.full
def test_our_quadruped_learns_to_keep_its_feet():
    # 140 thousand env states give -0.02 per step: it stands and acts calmly. An untrained policy thrashes: -3.1.
    sizes = ("num_envs=64", "data.num_env_states_per_minibatch=384", "data.num_minibatches=4")
    assert reward_after("quadruped_velocity_flat", 90, *SMALL, *sizes, *NETWORKS) > -0.1


@pytest.mark.full
@pytest.mark.parametrize("name", ["cartpole_balance", "cartpole_swingup", "pendulum_swingup"])
def test_a_task_is_solved(name):
    trainer = build(conf.compose([f"task={name}", "device=cpu", "logger=none"]))
    outcome = trainer.train()
    assert outcome.solved, outcome
    assert outcome.evaluation is not None and outcome.evaluation.episodes == 100
