"""The stable-baselines3 adapter, against its DummyVecEnv's conventions and with its own PPO."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor
from torchrl.data import Bounded, Unbounded

from ksim_rl import envs
from ksim_rl.adapters.stable_baselines3 import StableBaselines3VecEnv
from ksim_rl.testing import CounterEnv

LENGTHS = (3, 5, 4)


def test_ended_rows_carry_their_last_observation() -> None:
    """Even rows of CounterEnv terminate, odd ones are truncated; its observation is its own step."""
    env = StableBaselines3VecEnv(CounterEnv(LENGTHS), keys=["count"])
    assert np.array_equal(env.reset(), np.zeros((3, 1)))
    ended = []
    for _ in range(5):
        obs, reward, done, infos = env.step(np.full((3, 2), 0.5, dtype=np.float32))
        assert reward.tolist() == [1.0, 1.0, 1.0]
        for row in range(3):
            assert bool(infos[row]) == bool(done[row])
            if done[row]:
                assert obs[row] == 0
                assert infos[row]["terminal_observation"] == LENGTHS[row]
                ended.append((row, infos[row]["TimeLimit.truncated"]))
    assert ended == [(0, False), (2, False), (1, True)]


def test_one_observation_is_a_box_and_several_are_a_dict() -> None:
    several = StableBaselines3VecEnv(CounterEnv(LENGTHS), keys=["count", "row"])
    assert set(several.reset()) == {"count", "row"}
    assert set(several.observation_space.spaces) == {"count", "row"}
    assert StableBaselines3VecEnv(CounterEnv(LENGTHS), keys=["count"]).observation_space.shape == (
        1,
    )


def test_unbounded_actions_get_the_limit_and_others_keep_theirs() -> None:
    unbounded = CounterEnv(LENGTHS)
    unbounded.action_spec = Unbounded(unbounded.action_spec.shape)
    env = StableBaselines3VecEnv(unbounded, keys=["count"], action_limit=2.0)
    assert env.action_space.low.tolist() == [-2.0, -2.0] and env.action_space.high.tolist() == [
        2.0,
        2.0,
    ]
    cartpole = StableBaselines3VecEnv(
        envs.make("cartpole_balance", num_envs=2, seed=0), keys=["actor"], action_limit=2.0
    )
    assert (cartpole.action_space.low, cartpole.action_space.high) == (-1.0, 1.0)
    bounded = CounterEnv(LENGTHS)
    bounded.action_spec = Bounded(-3.0, 5.0, bounded.action_spec.shape)
    space = StableBaselines3VecEnv(bounded, keys=["count"]).action_space
    assert space.low.tolist() == [-3.0, -3.0] and space.high.tolist() == [5.0, 5.0]
    with pytest.raises(ValueError, match="action_limit"):
        StableBaselines3VecEnv(CounterEnv(LENGTHS), action_limit=0.0)
    with pytest.raises(NotImplementedError, match="change its config"):
        env.set_attr("seed", 1)
    env.close()


def test_the_seed_takes_effect_at_the_next_reset() -> None:
    env = StableBaselines3VecEnv(CounterEnv(LENGTHS), keys=["drawn"])
    env.seed(3)
    first = env.reset()
    env.seed(4)
    assert not np.array_equal(env.reset(), first)
    env.seed(3)
    assert np.array_equal(env.reset(), first)


@pytest.mark.full
def test_ppo_of_stable_baselines3_learns_cartpole() -> None:
    env = VecMonitor(
        StableBaselines3VecEnv(envs.make("cartpole_balance", num_envs=64, seed=0), keys=["actor"])
    )
    model = PPO(
        "MlpPolicy", env, n_steps=64, batch_size=512, n_epochs=8, gamma=0.98, seed=0, device="cpu"
    )
    model.learn(300_000)
    mean, std = evaluate_policy(model, env, n_eval_episodes=64)
    print(
        f"stable-baselines3 PPO, 300,000 env states: return of 64 episodes {mean:.1f} +- {std:.1f}"
    )
    assert mean > 900.0
    env.close()
