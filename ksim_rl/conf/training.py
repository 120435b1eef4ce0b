"""This module says what a task sets over the groups' choices: the fields in which its `training` differs from them."""

from collections.abc import Mapping
from typing import Any, get_type_hints

from ksim_rl import algorithms, envs
from ksim_rl.algorithms.registry import serving
from ksim_rl.config.config_tree import default_tree, to_tree
from ksim_rl.envs import Task
from ksim_rl.trainers import Algorithm, TrainingCfg

HINTS = get_type_hints(TrainingCfg)
OF_AN_ALGORITHM = ("objective", "data", "modules")
Tree = dict[str, Any]


def training_defaults(name: str) -> Tree:
    """Return what a task sets whatever the objective is, as a config tree."""
    task = envs.task(name)
    # The env's own number of envs and seed follow the run's.
    tree = {
        "task_name": name,
        "num_envs": task.cfg().scene.num_envs,
        "task": {"scene": {"num_envs": "${num_envs}"}, "seed": "${seed}"},
    }
    if task.training is None:
        return tree
    return tree | _changes(_of_all(_checked(task, task.training)), default_tree(TrainingCfg))


def objective_defaults(name: str, objective: str) -> Tree:
    """Return what a task sets for one algorithm, as a config tree.

    For an algorithm that it has no settings for, that is what fits of those in `training`: data and networks of the
    kinds that the algorithm has as well, and the settings that it inherits.
    """
    task, algorithm = envs.task(name), algorithms.algorithm(objective)
    if task.training is None:
        return {}
    base = _checked(task, task.training)
    for other in task.other_trainings:
        own = _checked(task, other)
        if serving(type(own.objective)) is algorithm:
            return _own_changes(own, algorithm) | _changes(_of_all(own), _of_all(base))
    source = serving(type(base.objective))
    changes = _own_changes(base, source)
    if source is algorithm:
        return changes
    fits = {
        "objective": issubclass(algorithm.cfg, type(base.objective)),
        "data": type(algorithm.data) is type(base.data),
        "modules": algorithm.modules.kinds == base.modules.kinds,
    }
    return {group: tree for group, tree in changes.items() if fits[group]}


def _own_changes(training: TrainingCfg, algorithm: Algorithm) -> Tree:
    defaults = {
        "objective": default_tree(algorithm.cfg, HINTS["objective"]),
        "data": to_tree(algorithm.data, HINTS["data"]),
        "modules": to_tree(algorithm.modules, HINTS["modules"]),
    }
    tree = to_tree(training, TrainingCfg)
    return _changes({group: tree[group] for group in OF_AN_ALGORITHM}, defaults)


def _of_all(training: TrainingCfg) -> Tree:
    tree = to_tree(training, TrainingCfg)
    return {key: value for key, value in tree.items() if key not in OF_AN_ALGORITHM}


def _changes(tree: Mapping[str, Any], base: Mapping[str, Any]) -> Tree:
    """Return the part of a tree in which it differs from another; where classes differ, that is all of it."""
    changes = {}
    for key, value in tree.items():
        below = base.get(key)
        if (
            isinstance(value, dict)
            and isinstance(below, dict)
            and value.get("_target_") == below.get("_target_")
        ):
            if inner := _changes(value, below):
                changes[key] = inner
        elif key not in base or value != below:
            changes[key] = value
    return changes


def _checked(task: Task, training: object) -> TrainingCfg:
    if not isinstance(training, TrainingCfg):
        raise ValueError(
            f"task {task.name!r}: training is a {type(training).__name__}; expected a "
            "`ksim_rl.trainers.TrainingCfg`, such as TrainingCfg(num_envs=256, objective=PPOCfg(), data=...)"
        )
    return training
