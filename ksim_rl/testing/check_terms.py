"""Finds terms of a `ManagerBasedRlEnv` that write memory of others, such as a reward that moves the robot."""

from torchrl.envs import EnvBase

from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.testing.replays import Replays, end_episodes_at_next_step


def check_terms(env: EnvBase, num_steps: int) -> None:
    """Terms write only their own memory: an event the state, in its rows, a reward nothing but its buffers."""
    base_env = part(env, ManagerBasedRlEnv)
    if base_env is None:
        return
    replays = Replays(env, num_steps)
    try:
        with base_env.watching_terms():
            root = replays.start()
            for index in range(num_steps):
                if index == num_steps // 2:
                    # Resets run events and curricula, which a short rollout might never reach.
                    end_episodes_at_next_step(env)
                _, root = replays.step(root, index)
    except ValueError as refusal:
        raise AssertionError(str(refusal)) from refusal
