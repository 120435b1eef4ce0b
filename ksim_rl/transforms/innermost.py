"""Finds the env inside its wrappers, and defines the one thing that a transform may ask of it."""

from abc import ABC, abstractmethod
from typing import Any

from torchrl.envs import EnvBase, TransformedEnv


class EpisodeLimit(ABC):
    """The part of an env that knows its time limit (see `ksim_rl.envs.contract`)."""

    @property
    @abstractmethod
    def max_episode_length(self) -> int:
        """Env steps after which an episode is cut; 0 for never."""


def innermost(env: EnvBase) -> Any:
    """Return the env inside all `TransformedEnv`s, stock or ours."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env
