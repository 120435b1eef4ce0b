"""Makes the choices of the config groups from the dataclasses, and each task's settings over them."""

from collections.abc import Mapping
from functools import partial
from typing import Any, get_type_hints

from hydra.core.config_store import ConfigStore

from ksim_rl import algorithms, envs
from ksim_rl.algorithms.off_policy import FEW_ENVS, MANY_ENVS
from ksim_rl.algorithms.ppo import DATA
from ksim_rl.algorithms.registry import serving
from ksim_rl.checked import Checked
from ksim_rl.config import upstream
from ksim_rl.config.config_tree import default_tree, to_tree
from ksim_rl.config.trees import Tree
from ksim_rl.envs import Task
from ksim_rl.modules import ActorCfg, CriticCfg, RecurrentCfg, SharedTrunkCfg
from ksim_rl.trainers import Algorithm, ModulesCfg, RunCfg, TrainingCfg
from ksim_rl.trainers.loggers import LoggerCfg, MLflowCfg, WandbCfg
from ksim_rl.trainers.run_cfg import BrowserCfg

# Annotations and defaults of a run, from which the groups are made.
HINTS = get_type_hints(RunCfg)
DEFAULTS = default_tree(RunCfg)
# Groups that change with the algorithm; the others belong to the task or the machine.
OF_AN_ALGORITHM = ("objective", "data", "modules")


def _recurrent(cfg: RecurrentCfg) -> ModulesCfg:
    return ModulesCfg(recurrent_actor=cfg, recurrent_critic=cfg)


# By group and name. The data and networks of an algorithm that are none of these go by its own name.
CHOICES: dict[str, dict[str, Checked]] = {
    "data": {"on_policy": DATA, "off_policy": MANY_ENVS, "off_policy_small": FEW_ENVS},
    "modules": {
        "mlp": ModulesCfg(),
        "gru": _recurrent(RecurrentCfg(kind="gru")),
        "lstm": _recurrent(RecurrentCfg(kind="lstm")),
        "shared_trunk": ModulesCfg(
            trunk=SharedTrunkCfg(),
            # The trunk normalizes.
            actor=ActorCfg(in_keys=("features",), hidden_dims=(128,), obs_normalization=False),
            critic=CriticCfg(in_keys=("features",), hidden_dims=(128,), obs_normalization=False),
        ),
    },
    "logger": {
        "local": LoggerCfg(),
        "none": LoggerCfg(csv=False, tensorboard=False),
        "wandb": LoggerCfg(tensorboard=False, wandb=WandbCfg()),
        "mlflow": LoggerCfg(tensorboard=False, mlflow=MLflowCfg()),
    },
    "viewer": {"none": BrowserCfg(), "browser": BrowserCfg(browser=True)},
}


def store_choices() -> None:
    """Store the choices of each group, in `objective` the algorithms, and `run`, the fields of no group."""
    # Fields of no group, at the top of the config.
    alone = ("task_name", "num_envs", "seed", "device", "checkpoint")
    ConfigStore.instance().store(name="run", node={name: DEFAULTS[name] for name in alone})
    upstream.store_config("collector", "rollout", lambda: DEFAULTS["collector"])
    upstream.store_config("trainer", "on_policy", lambda: DEFAULTS["trainer"])
    # A copy: the algorithms add their own choices below.
    choices = {group: dict(own) for group, own in CHOICES.items()}
    for name in algorithms.names():
        algorithm = algorithms.algorithm(name)
        chosen = {}
        for group in ("data", "modules"):
            cfg = getattr(algorithm, group)
            # An existing choice of the same content is used, so that names stay few.
            chosen[group] = next(
                (choice for choice, own in CHOICES[group].items() if own == cfg), name
            )
            choices[group].setdefault(chosen[group], cfg)
        # Made when Hydra loads it: building all trees takes longer than a command should.
        upstream.store_config("objective", name, partial(_objective, algorithm, chosen))
    for group, own in choices.items():
        for name, cfg in own.items():
            upstream.store_config(group, name, partial(to_tree, cfg, HINTS[group]))


def _objective(algorithm: Algorithm, chosen: Mapping[str, str]) -> Tree:
    # An algorithm chooses its data and networks, which the command line may override.
    overrides = [{f"override /{group}@_global_.{group}": name} for group, name in chosen.items()]
    return {"defaults": ["_self_", *overrides], **default_tree(algorithm.cfg, HINTS["objective"])}


def training_defaults(name: str) -> Tree:
    """Return a task's settings for any objective, as a config tree."""
    task = envs.task(name)
    # The env's own number of envs and seed follow the run's.
    tree = {
        "task_name": name,
        "num_envs": task.cfg().scene.num_envs,
        "task": {"scene": {"num_envs": "${num_envs}"}, "seed": "${seed}"},
    }
    # A task that is never trained has no settings.
    if task.training is None:
        return tree
    return tree | _changes(_of_all(_checked(task, task.training)), default_tree(TrainingCfg))


def objective_defaults(name: str, objective: str) -> Tree:
    """Return a task's settings for one algorithm, as a config tree.

    For an algorithm that it has no settings for, these are the settings in `training` that fit it: data and networks of
    the kinds that the algorithm has as well, and the settings that it inherits.
    """
    task = envs.task(name)
    algorithm = algorithms.algorithm(objective)
    if task.training is None:
        return {}
    base = _checked(task, task.training)
    # Settings that were made for this algorithm come first.
    for other in task.other_trainings:
        own = _checked(task, other)
        if serving(type(own.objective)) is algorithm:
            return _own_changes(own, algorithm) | _changes(_of_all(own), _of_all(base))
    # Else the settings of the main training, as far as they fit.
    source = serving(type(base.objective))
    changes = _own_changes(base, source)
    if source is algorithm:
        return changes
    # A group fits where the algorithm's config has the same kind: its fields mean the same there.
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
    # Only differences from the defaults: others may still be overridden by choices of groups.
    return _changes({group: tree[group] for group in OF_AN_ALGORITHM}, defaults)


def _of_all(training: TrainingCfg) -> Tree:
    tree = to_tree(training, TrainingCfg)
    return {key: value for key, value in tree.items() if key not in OF_AN_ALGORITHM}


def _changes(tree: Tree, base: Tree) -> Tree:
    """Return the part of a tree in which it differs from another; where classes differ, that is all of it."""
    changes = {}
    for key, value in tree.items():
        below: Any = base.get(key)
        are_trees = isinstance(value, dict) and isinstance(below, dict)
        # The same class on both sides: go on inside, else the whole tree counts.
        if are_trees and value.get("_target_") == below.get("_target_"):
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
