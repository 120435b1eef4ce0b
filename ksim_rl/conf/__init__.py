"""The Hydra configs of `ksim-rl train` as YAML, one folder per group, and their composition in Python."""

from collections.abc import Sequence
from functools import cache
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from ksim_rl import envs
from ksim_rl.conf import search_path
from ksim_rl.trainers import RunCfg

MODULE, NAME = "ksim_rl.conf", "train"


def compose(overrides: Sequence[str] = ()) -> RunCfg:
    """Compose a run's config, as `ksim-rl train <overrides>` does.

    Raises:
        ValueError: with the field or name that is wrong and the near ones.
    """
    register()
    GlobalHydra.instance().clear()
    with hydra.initialize_config_module(MODULE, version_base="1.3"):
        return compose_within(overrides)


def compose_within(overrides: Sequence[str]) -> RunCfg:
    """Do the same where Hydra is initialized already."""
    plain = OmegaConf.to_container(hydra.compose(NAME, overrides=list(overrides)), resolve=True)
    assert isinstance(plain, dict)
    return RunCfg.from_tree({str(key): value for key, value in plain.items()})


@cache
def register() -> None:
    """Let Hydra find other packages' configs, and store the tasks and their training defaults.

    They go to the groups `task` and `task/training`.
    """
    search_path.register()
    envs.register_configs()
    for name in envs.names():
        ConfigStore.instance().store(
            group="task/training", name=name, node=training_defaults(name), package="_global_"
        )


def training_defaults(name: str) -> dict[str, Any]:
    """Return what a task sets over the groups' defaults, as a config tree."""
    task = envs.task(name)
    # The env's own number of envs and seed follow the run's.
    tree = OmegaConf.create(
        {
            "task_name": name,
            "num_envs": task.cfg().scene.num_envs,
            "task": {"scene": {"num_envs": "${num_envs}"}, "seed": "${seed}"},
        }
    )
    for key, value in task.training.items():
        OmegaConf.update(tree, key, value)
    plain = OmegaConf.to_container(tree)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}
