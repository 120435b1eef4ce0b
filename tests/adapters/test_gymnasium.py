"""The Gymnasium adapter, against Gymnasium's checks and wrappers and against TorchRL's own rollout."""

from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils import env_checker, passive_env_checker
from gymnasium.vector import AutoresetMode

from ksim_rl import envs
from ksim_rl.adapters.gymnasium import GymnasiumVectorEnv
from ksim_rl.testing import CounterEnv

NUM_ENVS, LENGTHS = 3, (3, 5, 4)


@pytest.fixture(scope="module")
def cartpole() -> Iterator[GymnasiumVectorEnv]:
    env = GymnasiumVectorEnv(
        envs.make("cartpole_balance", num_envs=NUM_ENVS, seed=0, overrides=["task.sim.engine=c"])
    )
    yield env
    env.close()


def test_spaces_pass_gymnasiums_checks(cartpole: GymnasiumVectorEnv) -> None:
    passive_env_checker.check_space(
        cartpole.observation_space, "observation", passive_env_checker.check_observation_space
    )
    passive_env_checker.check_space(
        cartpole.action_space, "action", passive_env_checker.check_action_space
    )
    assert cartpole.observation_space == gym.vector.utils.batch_space(
        cartpole.single_observation_space, NUM_ENVS
    )
    assert cartpole.single_observation_space["actor"].shape == (5,)
    assert cartpole.single_action_space.shape == (1,)


@pytest.mark.parametrize(
    "check",
    [
        env_checker.check_reset_seed_determinism,
        env_checker.check_reset_options,
        env_checker.check_reset_return_type,
        env_checker.check_seed_deprecation,
    ],
)
def test_resets_pass_gymnasiums_checks(cartpole: GymnasiumVectorEnv, check) -> None:
    check(cartpole)


def test_returned_arrays_are_the_callers(cartpole: GymnasiumVectorEnv) -> None:
    first, _ = cartpole.reset(seed=1)
    kept = {name: value.copy() for name, value in first.items()}
    second, *_ = cartpole.step(cartpole.action_space.sample())
    for name, value in first.items():
        assert np.array_equal(value, kept[name])
        assert not np.shares_memory(value, second[name])


def test_steps_are_those_of_torchrl(cartpole: GymnasiumVectorEnv) -> None:
    torch.manual_seed(0)
    action_TEL = torch.randn(6, NUM_ENVS, 1)
    obs, _ = cartpole.reset(seed=7)
    got = [obs["actor"]]
    rewards = []
    for action_EL in action_TEL:
        obs, reward, terminated, truncated, _ = cartpole.step(action_EL.numpy())
        got.append(obs["actor"])
        rewards.append(reward)
        assert reward.shape == terminated.shape == truncated.shape == (NUM_ENVS,)
        assert terminated.dtype == truncated.dtype == bool

    td = cartpole.env.reset(seed=7)
    expected = [td["actor"].numpy()]
    for step, action_EL in enumerate(action_TEL):
        env_state_E, td = cartpole.env.step_and_maybe_reset(td.set("action", action_EL))
        expected.append(td["actor"].numpy())
        assert np.array_equal(env_state_E["next", "reward"][:, 0].numpy(), rewards[step])
    assert np.array_equal(np.stack(got), np.stack(expected))


def counter(*, tensors: bool = False) -> GymnasiumVectorEnv:
    return GymnasiumVectorEnv(CounterEnv(LENGTHS, action_size=1), keys=["count"], tensors=tensors)


def test_the_last_observation_is_where_gymnasium_puts_it() -> None:
    """CounterEnv observes its own step: row e ends at LENGTHS[e] and starts again at 0."""
    env = counter()
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    env.reset(seed=0)
    seen = 0
    for _ in range(15):
        obs, _, terminated, truncated, infos = env.step(env.action_space.sample())
        ended = terminated | truncated
        assert ("final_obs" in infos) == bool(ended.any())
        if ended.any():
            assert np.array_equal(infos["_final_obs"], ended)
            assert not terminated[1::2].any() and not truncated[::2].any()
            for row in range(NUM_ENVS):
                if not ended[row]:
                    assert infos["final_obs"][row] is None
                    continue
                seen += 1
                assert infos["final_obs"][row][0] == LENGTHS[row]
                assert obs[row, 0] == 0
    assert seen == 15 // 3 + 15 // 5 + 15 // 4


def test_gymnasiums_wrappers_work_on_top() -> None:
    env = gym.wrappers.vector.RecordEpisodeStatistics(counter())
    env.reset(seed=0)
    lengths = []
    for _ in range(5):
        *_, infos = env.step(env.action_space.sample())
        if "episode" in infos:
            lengths += list(infos["episode"]["l"][infos["_episode"]])
    assert lengths == [3, 4, 5]


def test_tensors_stay_tensors_for_all_rows() -> None:
    env = counter(tensors=True)
    env.reset(seed=0)
    for _ in range(3):
        obs, reward, terminated, truncated, infos = env.step(torch.zeros(env.action_space.shape))
    assert all(isinstance(value, torch.Tensor) for value in (obs, reward, terminated, truncated))
    assert infos["_final_obs"].tolist() == [True, False, False]
    assert infos["final_obs"].flatten().tolist() == [3.0, 3.0, 3.0]
    assert obs.flatten().tolist() == [0.0, 3.0, 3.0]


def test_wrong_input_is_refused(cartpole: GymnasiumVectorEnv) -> None:
    with pytest.raises(ValueError, match="no reset options"):
        cartpole.reset(options={"low": 0})
    with pytest.raises(ValueError, match=r"expected torch.float32 of shape \(3, 1\)"):
        cartpole.step(np.zeros((3, 2), dtype=np.float32))
    with pytest.raises(ValueError, match="did you mean 'actor'"):
        GymnasiumVectorEnv(cartpole.env, keys=["actr"])
