"""Defines a task: an env config under a name, with settings for training."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg


class Training(Protocol):
    """The part of the training settings that this room reads; their classes are in rooms above."""

    @property
    def num_envs(self) -> int: ...  # noqa: D102
    @property
    def seed(self) -> int: ...  # noqa: D102


@dataclass(frozen=True, kw_only=True)
class Task:
    """An env config with settings for training; it is at the top level of a module of `ksim_rl/tasks/`.

    A module of many tasks may hold them in a sequence `TASKS` instead.

    `name` is as in `task=<name>`, `description` one line for the table of tasks.

    Attributes:
        training: the settings of training, a `ksim_rl.trainers.TrainingCfg`; the command line overrides them. Other
            algorithms than its `objective` use the fields that fit them. None leaves all to the defaults.
        other_trainings: the same with the settings of other algorithms.
        solved_at: the mean evaluation return that counts as solved; None if there is no such figure.
        suite: the suite of another package that the task is of; "" for our own tasks.
    """

    name: str
    description: str
    cfg: Callable[[], ManagerBasedRlEnvCfg]
    training: Training | None = None
    other_trainings: tuple[Training, ...] = ()
    solved_at: float | None = None
    suite: str = ""
