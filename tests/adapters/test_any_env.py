"""The adapters on envs that are not ours: TorchRL's SerialEnv and GymEnv, nested keys, choices and other dtypes."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs import GymEnv, SerialEnv

from ksim_rl.adapters.gymnasium import GymnasiumVectorEnv
from ksim_rl.adapters.stable_baselines3 import StableBaselines3VecEnv
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from tests.envs.nested_signals import NestedSignals

LENGTHS = (3, 5, 4)
ENVS = {
    "GymEnv": lambda: GymEnv("Pendulum-v1"),
    "GymEnv of choices": lambda: GymEnv("CartPole-v1"),
    "GymEnv of indices": lambda: GymEnv("CartPole-v1", categorical_action_encoding=True),
    "SerialEnv": lambda: SerialEnv(2, lambda: GymEnv("Pendulum-v1")),
    "SerialEnv of choices": lambda: SerialEnv(2, lambda: GymEnv("CartPole-v1")),
    "SerialEnv of ours": lambda: SerialEnv(2, lambda: CounterEnv(())),
    "no batch dims": lambda: CounterEnv(()),
    "nested": lambda: NestedSignals(LENGTHS),
}


@pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)
def test_gymnasiums_interface(make):
    env = GymnasiumVectorEnv(make())
    env.action_space.seed(0)
    obs, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    assert obs in env.observation_space
    leaves = zip(
        torch.utils._pytree.tree_leaves(obs), torch.utils._pytree.tree_leaves(again), strict=True
    )
    assert all(np.array_equal(one, other) for one, other in leaves)
    for _ in range(12):
        obs, reward, terminated, truncated, infos = env.step(env.action_space.sample())
        assert obs in env.observation_space
        assert reward.shape == terminated.shape == truncated.shape == (env.num_envs,)
        assert reward.dtype == np.float32 and np.isfinite(reward).all()
        assert ("final_obs" in infos) == bool((terminated | truncated).any())
    env.close()


@pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)
def test_stable_baselines3s_interface(make):
    env = StableBaselines3VecEnv(make())
    env.action_space.seed(0)
    for name in ("observation_space", "action_space", "render_mode"):
        assert env.get_attr(name) == [getattr(env, name)] * env.num_envs
    assert env.get_attr("batch_size", 0) == [env.env.batch_size]
    env.seed(3)
    env.reset()
    for _ in range(12):
        obs, reward, done, infos = env.step(
            np.stack([env.action_space.sample() for _ in range(env.num_envs)])
        )
        assert reward.shape == done.shape == (env.num_envs,) and len(infos) == env.num_envs
        rows = obs if isinstance(obs, np.ndarray) else next(iter(obs.values()))
        assert len(rows) == env.num_envs
    env.close()


def test_steps_of_a_gym_env_are_gymnasiums_own():
    theirs, ours = gym.make("Pendulum-v1"), GymnasiumVectorEnv(GymEnv("Pendulum-v1"))
    first, _ = ours.reset(seed=1)
    theirs.unwrapped.state = None
    theirs.reset(seed=0)
    theirs.unwrapped.state = np.array([np.arctan2(first[0, 1], first[0, 0]), first[0, 2]])
    for torque in (1.5, -2.0, 0.3):
        expected, reward, *_ = theirs.step(np.array([torque], np.float32))
        obs, got, *_ = ours.step(np.array([[torque]], np.float32))
        np.testing.assert_allclose(obs[0], expected, atol=1e-5)
        np.testing.assert_allclose(got, reward, atol=1e-5)


def test_spaces_are_those_of_the_env():
    assert GymnasiumVectorEnv(GymEnv("CartPole-v1")).single_action_space == spaces.Discrete(2)
    pendulum = GymnasiumVectorEnv(SerialEnv(2, lambda: GymEnv("Pendulum-v1")))
    reference = gym.make("Pendulum-v1")
    assert pendulum.single_action_space == reference.action_space
    assert pendulum.single_observation_space == reference.observation_space


def test_a_list_of_seeds_is_one_per_env():
    env = GymnasiumVectorEnv(CounterEnv(LENGTHS), keys=["drawn"])

    def drawn(seed):
        return env.reset(seed=seed)[0].tolist()

    assert drawn([5, 6, 7]) == drawn(5) != drawn([5, 6, 8])
    assert drawn([5, 6, 8]) == drawn([5, 6, 8]) != drawn([8, 6, 5])
    assert drawn([None, None, None]) != drawn([None, None, None])
    with pytest.raises(ValueError, match=r"seed=\[1, 2\]: expected one per env, 3"):
        env.reset(seed=[1, 2])


def test_several_rewards_per_row_are_refused():
    env = CounterEnv(LENGTHS)
    env.full_reward_spec = env.full_reward_spec.clone().set(
        "reward", env.observation_spec["obs", "vector"].clone()
    )
    with pytest.raises(ValueError, match="'reward' has several numbers per row"):
        GymnasiumVectorEnv(env)


def test_rewards_and_ends_are_read_where_the_env_has_them():
    plain = GymnasiumVectorEnv(CounterEnv(LENGTHS), keys=["count"])
    nested = GymnasiumVectorEnv(NestedSignals(LENGTHS), keys={"count": ("agent", "count")})
    plain.reset(seed=0), nested.reset(seed=0)
    action = np.full((3, 2), 0.5, np.float32)
    for _ in range(8):
        one, other = plain.step(action), nested.step(action)
        assert np.array_equal(one[0], other[0])
        assert all(np.array_equal(a, b) for a, b in zip(one[1:4], other[1:4], strict=True))
    assert torch.is_tensor(nested._stepper.root["agent", "done"])


@pytest.mark.parametrize("adapter", [GymnasiumVectorEnv, StableBaselines3VecEnv])
def test_one_key_may_be_given_as_it_is(adapter):
    one = adapter(CounterEnv(LENGTHS), keys="count")
    listed = adapter(CounterEnv(LENGTHS), keys=["count"])
    assert one.observation_space == listed.observation_space
    with pytest.raises(ValueError, match="no observation 'cont': did you mean 'count'"):
        adapter(CounterEnv(LENGTHS), keys="cont")


def test_a_step_by_an_action_alone_says_how_envs_of_torchrl_are_stepped():
    env = MaskedTransformedEnv(CounterEnv(LENGTHS))
    for action in (torch.zeros(3, 2), np.zeros((3, 2))):
        with pytest.raises(
            ValueError, match=r'env.step\(td.set\("action", action\)\).*ksim_rl.adapters'
        ):
            env.step(action)
