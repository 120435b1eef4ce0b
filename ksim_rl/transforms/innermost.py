"""The env inside its wrappers."""

from typing import Any

from torchrl.envs import EnvBase, TransformedEnv


def innermost(env: EnvBase) -> Any:
    """Return the env inside all `TransformedEnv`s, stock or ours."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
