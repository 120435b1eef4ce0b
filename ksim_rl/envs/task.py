"""What a registered task is."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg


@dataclass(frozen=True, kw_only=True)
class Task:
    """An env config with what is known about training it.

    A module in `ksim_rl/tasks/` that holds one at its top level registers it.

    Attributes:
        name: as in `task=<name>`.
        description: one line for the table of tasks.
        cfg: returns the env's config.
        training: defaults for training by dotted config key, such as `{"objective.gamma": 0.99}`; the command line
            overrides them. Those of `objective`, `data` and `modules` are PPO's.
        training_by_objective: the same for other objectives, by the name of the config, such as
            `{"fast_td3": {"objective.gamma": 0.97}}`; they lie over those of `training` that are not PPO's.
        solved_at: the mean evaluation return that counts as solved; None if there is no such figure.
    """

    name: str
    description: str
    cfg: Callable[[], ManagerBasedRlEnvCfg]
    training: Mapping[str, Any] = field(default_factory=dict)
    training_by_objective: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    solved_at: float | None = None
