"""Trains cartpole with the example for a few iterations."""

import importlib.util
from pathlib import Path

import pytest
import torch

EXAMPLE = Path(__file__).parents[2] / "examples" / "one_file_ppo.py"
SMALL = [
    "task=cartpole_balance",
    "device=cpu",
    "num_envs=16",
    "num_iterations=4",
    "log_interval=2",
    "seed=3",
    "data.num_env_states_per_minibatch=128",
    "data.num_minibatches=2",
    "objective.num_epochs=2",
    "actor.hidden_dims=(16,16)",
]


def _example():
    spec = importlib.util.spec_from_file_location("one_file_ppo", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_trains_cartpole_and_reports_speed_and_return(capsys):
    example = _example()
    lines = example.train(example.read_settings(SMALL))
    assert [line["iteration"] for line in lines] == [2, 4]
    assert all(line["env_states_per_s"] > 0.0 and line["skipped_steps"] == 0.0 for line in lines)
    assert any(line["kl"] > 0.0 for line in lines)
    assert "env_states_per_s" in capsys.readouterr().out


def test_settings_are_the_tasks_but_for_what_is_given():
    settings = _example().read_settings(SMALL)
    assert (settings.num_envs, settings.data.num_env_states, settings.objective.num_epochs) == (
        16,
        256,
        2,
    )
    assert settings.actor.hidden_dims == (16, 16) and settings.critic.hidden_dims == (64, 64)
    assert settings.objective.clip_value is False


def test_its_networks_fit_the_fused_kernels():
    pytest.importorskip("triton")
    from ksim_rl import envs

    example = _example()
    settings = example.read_settings([*SMALL, "objective.precision='bfloat16'"])
    env = envs.make(settings.task, num_envs=settings.num_envs, seed=settings.seed)
    assert example.make_fused(settings, example.PPO(settings, env)) is not None


def test_an_update_changes_the_networks_as_the_trainers_update_does():
    from ksim_rl import envs
    from ksim_rl.algorithms.ppo.update import PPOUpdate
    from ksim_rl.collectors import RolloutCollector

    example = _example()
    settings = example.read_settings(SMALL)
    env = envs.make(settings.task, num_envs=settings.num_envs, seed=settings.seed)
    torch.manual_seed(0)
    ours = example.PPO(settings, env)
    torch.manual_seed(0)
    twin = example.PPO(settings, env)
    theirs = PPOUpdate(
        settings.objective,
        actor=twin.actor,
        critic=twin.critic,
        data=settings.data,
        seed=settings.seed,
    )
    rollout_ET = RolloutCollector(
        env, ours.actor, rollout_length=16, keys=ours.rollout_keys
    ).collect()
    ours.update(rollout_ET.clone())
    theirs(rollout_ET.clone())
    for mine, other in zip(
        (*ours.actor.parameters(), *ours.critic.parameters()),
        (*theirs.actor.parameters(), *theirs.critic.parameters()),
        strict=True,
    ):
        torch.testing.assert_close(mine, other, rtol=0.0, atol=0.0)


def test_it_needs_no_trainer_and_few_lines():
    text = EXAMPLE.read_text()
    assert "ksim_rl.trainers" not in text and len(text.splitlines()) <= 450
