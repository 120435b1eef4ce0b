"""The Hydra configs of `ksim-rl train` as YAML, one folder per group, and their composition in Python."""

from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ksim_rl import envs
from ksim_rl.conf import search_path
from ksim_rl.config import stored_configs
from ksim_rl.trainers import RunCfg

MODULE, NAME = "ksim_rl.conf", "train"
RUN_AGAIN, RUN_CONFIG = "run_again", "config.yaml"
PPO = "ppo"
# What objectives take of a task's settings for PPO, unless it has some for them.
TAKEN_FROM_PPO = {
    PPO: ("objective", "data", "modules"),
    "amp": ("objective", "data", "modules"),
    "distillation": ("data", "modules"),
}


def compose(overrides: Sequence[str] = ()) -> RunCfg:
    """Compose a run's config, as `ksim-rl train <overrides>` does.

    Raises:
        ValueError: with the field or name that is wrong and the near ones.
    """
    register()
    GlobalHydra.instance().clear()
    with hydra.initialize_config_module(MODULE, version_base="1.3"):
        return compose_within(overrides)


def compose_within(overrides: Sequence[str], *, name: str = NAME) -> RunCfg:
    """Do the same where Hydra is initialized already; `name` is that of the primary config."""
    plain = OmegaConf.to_container(hydra.compose(name, overrides=list(overrides)), resolve=True)
    assert isinstance(plain, dict)
    return RunCfg.from_tree({str(key): value for key, value in plain.items()})


@cache
def register() -> None:
    """Let Hydra find other packages' configs, and store the tasks and their training defaults.

    They go to the groups `task`, `task/training` (what holds for any objective) and `task/objective_training`.
    """
    search_path.register()
    envs.register_configs()
    store = partial(stored_configs.store, package="_global_")
    for name in envs.names():
        store("task/training", name, partial(training_defaults, name))
        for objective in (*TAKEN_FROM_PPO, *envs.task(name).training_by_objective):
            make = partial(objective_defaults, name, objective)
            store("task/objective_training", f"{name}_{objective}", make)
    stored_configs.quicken()


def register_run(folder: Path) -> bool:
    """Store the config that a run left in its folder as the primary config `RUN_AGAIN`; False if there is none.

    Its number of envs and its seed follow overrides, as they do in a config that is composed.

    Raises:
        ValueError: if its file is not YAML.
    """
    path = folder / RUN_CONFIG
    try:
        tree = OmegaConf.to_container(OmegaConf.load(path)) if path.is_file() else None
    except (YAMLError, OmegaConfBaseException) as error:
        raise ValueError(f"{path}: cannot be read: {error}") from error
    if not isinstance(tree, dict) or not {"task_name", "task"} <= tree.keys():
        return False
    task = tree["task"]
    if not isinstance(task, dict) or not isinstance(task.get("scene"), dict):
        raise ValueError(f"{path}: task={task!r}: expected the config of an env, as a run writes it")
    task["scene"]["num_envs"] = "${num_envs}"
    if task.get("seed") == tree.get("seed"):
        task["seed"] = "${seed}"
    ConfigStore.instance().store(name=RUN_AGAIN, node={"defaults": ["launch", "_self_"], **tree})
    return True


def training_defaults(name: str) -> dict[str, Any]:
    """Return what a task sets over the groups' defaults whatever the objective is, as a config tree."""
    task = envs.task(name)
    # The env's own number of envs and seed follow the run's.
    tree = {
        "task_name": name,
        "num_envs": task.cfg().scene.num_envs,
        "task": {"scene": {"num_envs": "${num_envs}"}, "seed": "${seed}"},
    }
    of_all = {key: value for key, value in task.training.items() if _group(key) not in TAKEN_FROM_PPO[PPO]}
    return _with(tree, of_all)


def objective_defaults(name: str, objective: str) -> dict[str, Any]:
    """Return what a task sets for one objective, as a config tree."""
    task = envs.task(name)
    if objective in task.training_by_objective:
        return _with({}, task.training_by_objective[objective])
    taken = TAKEN_FROM_PPO[objective]
    return _with({}, {key: value for key, value in task.training.items() if _group(key) in taken})


def _group(key: str) -> str:
    return key.partition(".")[0]


def _with(tree: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a tree with values set at dotted keys."""
    config = OmegaConf.create(dict(tree))
    for key, value in values.items():
        OmegaConf.update(config, key, value)
    plain = OmegaConf.to_container(config)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}
