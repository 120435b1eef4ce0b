"""The rsl_rl adapter, with rsl_rl's own runner."""

from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.runners import OnPolicyRunner

from ksim_rl import envs
from ksim_rl.adapters.rsl_rl import RslRlVecEnv
from ksim_rl.testing import CounterEnv


def runner_cfg(*, num_steps: int = 24) -> dict[str, Any]:
    model = {
        "class_name": "MLPModel",
        "hidden_dims": [64, 64],
        "activation": "elu",
        "obs_normalization": True,
    }
    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}
    return {
        "num_steps_per_env": num_steps,
        "save_interval": 1000,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "actor": model | {"distribution_cfg": gaussian},
        "critic": dict(model),
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 5,
            "num_mini_batches": 4,
            "learning_rate": 1e-3,
            "schedule": "adaptive",
            "desired_kl": 0.01,
            "gamma": 0.98,
            "lam": 0.95,
            "entropy_coef": 0.005,
            "clip_param": 0.2,
            "use_clipped_value_loss": False,
            "value_loss_coef": 1.0,
            "max_grad_norm": 1.0,
        },
    }


def test_steps_are_those_of_torchrl() -> None:
    vec_env = RslRlVecEnv(envs.make("cartpole_balance", num_envs=3, seed=5), log_interval=2)
    assert (vec_env.num_envs, vec_env.num_actions, vec_env.max_episode_length) == (3, 1, 1000)
    torch.manual_seed(0)
    action_TEL = torch.randn(4, 3, 1)
    got = [vec_env.get_observations()["actor"]]
    logs = []
    for action_EL in action_TEL:
        obs, reward_E, done_E, extras = vec_env.step(action_EL)
        assert obs.batch_size == torch.Size([3]) and reward_E.shape == done_E.shape == (3,)
        assert extras["time_outs"].shape == (3,)
        got.append(obs["actor"])
        logs.append(extras.get("log"))
    assert [log is not None for log in logs] == [False, True, False, True]

    vec_env.env.seed(5)
    td = vec_env.env.reset()
    expected = [td["actor"].clone()]
    for action_EL in action_TEL:
        _, td = vec_env.env.step_and_maybe_reset(td.set("action", action_EL))
        expected.append(td["actor"].clone())
    assert torch.equal(torch.stack(got), torch.stack(expected))
    vec_env.close()


def test_time_outs_and_the_log_of_episodes() -> None:
    env = envs.make(
        "cartpole_balance", num_envs=2, seed=0, overrides=["task.episode_length_s=0.03"]
    )
    vec_env = RslRlVecEnv(env, log_interval=3)
    for _ in range(3):
        *_, done_E, extras = vec_env.step(torch.zeros(2, 1))
    assert done_E.tolist() == [1, 1] and extras["time_outs"].tolist() == [True, True]
    assert extras["log"]["Episode/length"] == 3.0
    assert extras["log"]["Episode/termination/time_out"] == 1.0
    vec_env.close()


def test_a_failure_at_the_last_step_is_no_time_out() -> None:
    # The pole hangs from the start, which is a fall.
    overrides = [
        "task.episode_length_s=0.01",
        "task.events.reset.angle=3.1",
        "task.events.reset.angle_range=3.0",
    ]
    vec_env = RslRlVecEnv(envs.make("cartpole_balance", num_envs=64, seed=0, overrides=overrides))
    *_, done_E, extras = vec_env.step(torch.zeros(64, 1))
    fallen_E = vec_env.unwrapped.view.terminated_E
    assert done_E.all() and fallen_E.any() and not fallen_E.all()
    assert torch.equal(extras["time_outs"], ~fallen_E)
    vec_env.close()


def test_rsl_rl_spreads_the_time_outs_through_the_clock() -> None:
    vec_env = RslRlVecEnv(envs.make("cartpole_balance", num_envs=2, seed=0))
    vec_env.get_observations()
    vec_env.episode_length_buf = torch.tensor([998, 0])
    vec_env.step(torch.zeros(2, 1))
    assert vec_env.episode_length_buf.tolist() == [999, 1]
    _, _, done_E, _ = vec_env.step(torch.zeros(2, 1))
    assert done_E.tolist() == [1, 0] and vec_env.episode_length_buf.tolist() == [0, 2]
    vec_env.close()


def test_other_envs_are_refused() -> None:
    with pytest.raises(ValueError, match="CounterEnv"):
        RslRlVecEnv(CounterEnv())


def test_the_runner_runs(tmp_path: Path) -> None:
    vec_env = RslRlVecEnv(envs.make("cartpole_balance", num_envs=4, seed=0))
    runner = OnPolicyRunner(vec_env, runner_cfg(num_steps=8), log_dir=str(tmp_path), device="cpu")
    runner.learn(2, init_at_random_ep_len=True)
    assert list(tmp_path.glob("events*"))
    vec_env.close()


@pytest.mark.full
def test_the_runner_of_rsl_rl_learns_cartpole(tmp_path: Path) -> None:
    torch.manual_seed(0)
    vec_env = RslRlVecEnv(envs.make("cartpole_balance", num_envs=256, seed=0), log_interval=64)
    cfg = runner_cfg(num_steps=64)
    cfg["algorithm"] |= {
        "schedule": "fixed",
        "num_mini_batches": 8,
        "gamma": 0.99,
        "entropy_coef": 0.0,
    }
    runner = OnPolicyRunner(vec_env, cfg, log_dir=str(tmp_path), device="cpu")
    runner.learn(60)

    policy = runner.get_inference_policy()
    vec_env.env.seed(1)
    obs, _ = vec_env.reset()
    return_E, alive_E = torch.zeros(256), torch.ones(256)
    with torch.inference_mode():
        for _ in range(1000):
            obs, reward_E, done_E, _ = vec_env.step(policy(obs))
            return_E += alive_E * reward_E
            alive_E *= 1 - done_E
    print(
        f"rsl_rl PPO, 983,040 env states: mean return of 256 fresh episodes {return_E.mean():.1f}"
    )
    assert return_E.mean() > 900.0
    vec_env.close()
