"""Autoreset modes against Gymnasium's own `SyncVectorEnv`, and the single env against the checks of others."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils import env_checker
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common import env_checker as sb3_checker

from ksim_rl import envs
from ksim_rl.adapters.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from ksim_rl.adapters.spaces import finite
from ksim_rl.testing import CounterEnv

LENGTHS = (3, 5, 4)


class Counter(gym.Env):
    """Observes its own step; it ends after `length` of them, by a time-out in odd rows, as `CounterEnv` does."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, row: int) -> None:
        self.row = row

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        ended = self.count >= LENGTHS[self.row]
        return (
            np.full(1, self.count, np.float32),
            1.0,
            ended and not self.row % 2,
            ended and bool(self.row % 2),
            {},
        )


def pair(mode: AutoresetMode) -> tuple[GymnasiumVectorEnv, SyncVectorEnv]:
    ours = GymnasiumVectorEnv(
        CounterEnv(LENGTHS, action_size=1), keys=["count"], autoreset_mode=mode
    )
    theirs = SyncVectorEnv([lambda row=row: Counter(row) for row in range(3)], autoreset_mode=mode)
    ours.reset(seed=0)
    theirs.reset(seed=0)
    return ours, theirs


@pytest.mark.parametrize("mode", AutoresetMode)
def test_modes_are_gymnasiums(mode):
    ours, theirs = pair(mode)
    assert ours.metadata["autoreset_mode"] is mode
    for _ in range(14):
        action = theirs.action_space.sample()
        obs, _, terminated, truncated, infos = ours.step(action)
        expected, reward, their_ends, their_cuts, their_infos = theirs.step(action)
        np.testing.assert_array_equal(obs, expected)
        np.testing.assert_array_equal(terminated, their_ends)
        np.testing.assert_array_equal(truncated, their_cuts)
        assert ("final_obs" in infos) == ("final_obs" in their_infos)
        if mode is AutoresetMode.DISABLED and (terminated | truncated).any():
            mask = {"reset_mask": terminated | truncated}
            np.testing.assert_array_equal(
                ours.reset(options=mask)[0], theirs.reset(options=mask)[0]
            )


def test_the_step_of_a_reset_has_no_reward():
    made = envs.make(
        "cartpole_balance", num_envs=2, seed=0, overrides=["task.episode_length_s=0.02"]
    )
    env = GymnasiumVectorEnv(made, keys=["actor"], autoreset_mode="NEXT_STEP")
    env.reset(seed=1)
    rewards = []
    for _ in range(6):
        obs, reward, terminated, truncated, infos = env.step(np.zeros((2, 1), np.float32))
        rewards.append(reward.tolist())
        assert not infos
    zero = [row == [0.0, 0.0] for row in rewards]
    assert any(zero) and not all(zero)
    # The step after an end, and only that one.
    first = zero.index(True)
    assert zero == [step % (first + 1) == first for step in range(6)]


def test_a_new_episode_in_the_next_step_is_that_of_a_reset():
    kwargs = {"num_envs": 2, "seed": 0, "overrides": ["task.episode_length_s=0.02"]}
    late = GymnasiumVectorEnv(
        envs.make("cartpole_balance", **kwargs), keys=["actor"], autoreset_mode="NEXT_STEP"
    )
    same = GymnasiumVectorEnv(envs.make("cartpole_balance", **kwargs), keys=["actor"])
    late.reset(seed=1)
    same.reset(seed=1)
    action = np.full((2, 1), 0.5, np.float32)
    while True:
        obs, _, terminated, truncated, _ = late.step(action)
        fresh, _, _, _, infos = same.step(action)
        if (terminated | truncated).all():
            break
        np.testing.assert_array_equal(obs, fresh)
    np.testing.assert_array_equal(obs, np.stack([*infos["final_obs"]]))
    np.testing.assert_array_equal(late.step(action)[0], fresh)


@pytest.fixture(scope="module")
def single():
    env = GymnasiumEnv(envs.make("cartpole_balance", num_envs=1, seed=0), keys=["actor"])
    yield env
    env.close()


def test_a_single_env_passes_gymnasiums_check(single, recwarn):
    env_checker.check_env(single, skip_render_check=True)
    ours = [str(warning.message) for warning in recwarn if "Box" in str(warning.message)]
    assert all("infinity" in text for text in ours), ours


def test_a_single_env_passes_stable_baselines3s_check(single):
    sb3_checker.check_env(single, warn=True, skip_render_check=True)


def test_a_single_env_is_that_of_torchrl(single):
    first, _ = single.reset(seed=3)
    obs, reward, terminated, truncated, _ = single.step(np.array([0.3], np.float32))
    td = single.env.reset(seed=3)
    np.testing.assert_array_equal(first, td["actor"][0].numpy())
    following = single.env.step(td.set("action", torch.tensor([[0.3]])))["next"]
    np.testing.assert_array_equal(obs, following["actor"][0].numpy())
    assert (reward, terminated, truncated) == (following["reward"].item(), False, False)
    assert type(reward) is float and type(terminated) is bool


def test_actions_without_bounds_get_finite_ones():
    space = finite(gym.spaces.Box(np.array([-np.inf, -3.0]), np.array([np.inf, np.inf])), 2.0)
    assert (space.low.tolist(), space.high.tolist()) == ([-2.0, -3.0], [2.0, 2.0])
    assert finite(gym.spaces.Discrete(3), 2.0) == gym.spaces.Discrete(3)


def test_tasks_are_registered_for_make_and_make_vec():
    assert {f"ksim_rl/{name}-v0" for name in envs.names()} <= gym.registry.keys()
    env = gym.make("ksim_rl.adapters.gymnasium:ksim_rl/cartpole_balance-v0", seed=0)
    obs, _ = env.reset(seed=1)
    assert obs.shape == (5,) and isinstance(env.unwrapped, GymnasiumEnv)
    env.step(env.action_space.sample())
    vector = gym.make_vec("ksim_rl/cartpole_balance-v0", num_envs=3, autoreset_mode="NEXT_STEP")
    assert vector.reset(seed=0)[0].shape == (3, 5)
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    # CleanRL's way, in which each env is one row.
    several = SyncVectorEnv(
        [lambda: gym.wrappers.FlattenObservation(gym.make("ksim_rl/cartpole_balance-v0"))] * 2
    )
    assert several.reset(seed=0)[0].shape == (2, 5)


def test_wrong_input_is_refused(single):
    with pytest.raises(ValueError, match="one of SAME_STEP, NEXT_STEP, DISABLED"):
        GymnasiumVectorEnv(single.env, autoreset_mode="SOON")
    with pytest.raises(ValueError, match="a single env has one row"):
        GymnasiumEnv(CounterEnv(LENGTHS))
    with pytest.raises(ValueError, match="no reset options"):
        single.reset(options={"low": 0})
    ours, _ = pair(AutoresetMode.DISABLED)
    for options, seed, message in (
        ({"reset_mask": np.ones(2, bool)}, None, r"expected bool \(3,\)"),
        ({"reset_mask": np.ones(3, bool)}, 1, "takes reset_mask alone"),
    ):
        with pytest.raises(ValueError, match=message):
            ours.reset(seed=seed, options=options)
