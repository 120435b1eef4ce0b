import numpy as np
import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.state.motion_clock import motion_time
from tests.envs.probe_env import DT, puck_env, push

FPS = 1.0 / DT


@pytest.fixture
def clip(tmp_path):
    """The puck at x(t) = t^2 for 2 s, in a frame per env step."""
    time = np.arange(101) * DT
    file = tmp_path / "puck.npz"
    np.savez(file, fps=FPS, qpos=time[:, None] ** 2, qvel=2.0 * time[:, None])
    return str(file)


def motion_env(clip, num_envs=64, **fields):
    return puck_env(
        num_envs=num_envs, limit=None, events={"motion": mdp.ResetToMotion(file=clip, **fields)}
    )


def test_episodes_begin_in_states_of_the_motion(clip):
    env = motion_env(clip, start_range=(0.25, 1.0))
    root_E = env.reset()
    time_E = motion_time(env.view, clip)
    assert time_E.min() >= 0.5 - 1e-6 and time_E.max() <= 2.0 and time_E.std() > 0.3
    # Linear between frames of a parabola: off by at most DT^2 / 4.
    torch.testing.assert_close(root_E["obs", "position"][:, 0], time_E**2, atol=DT**2 / 3, rtol=0)
    torch.testing.assert_close(root_E["obs", "velocity"][:, 0], 2.0 * time_E, atol=1e-4, rtol=0)


def test_the_motions_time_goes_on_with_the_episode_and_a_reset_moves_its_rows_only(clip):
    env = motion_env(clip, num_envs=3)
    root_E = env.reset()
    before_E = motion_time(env.view, clip).clone()
    push(env, root_E)
    torch.testing.assert_close(motion_time(env.view, clip), before_E + DT)
    env.reset(env_ids=[1])
    after_E = motion_time(env.view, clip)
    torch.testing.assert_close(after_E[[0, 2]], before_E[[0, 2]] + DT)
    assert after_E[1] not in (before_E[1], before_E[1] + DT)


def test_a_clip_of_another_robot_is_refused_at_construction(tmp_path):
    file = tmp_path / "other.npz"
    np.savez(file, fps=50.0, qpos=np.zeros((4, 7)), qvel=np.zeros((4, 6)))
    with pytest.raises(ValueError, match=r"qpos has shape \(4, 7\): expected \[F, 1\]"):
        motion_env(str(file))


def test_shares_outside_of_the_clip_are_refused():
    with pytest.raises(ValueError, match=r"start_range\[1\]=1.5"):
        mdp.ResetToMotion(file="x.npz", start_range=(0.0, 1.5))
