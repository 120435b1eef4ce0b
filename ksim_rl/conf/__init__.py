"""This room composes the config of `ksim-rl train` with Hydra, from YAML, the dataclasses and what is registered."""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ksim_rl import algorithms, envs
from ksim_rl.conf import choices
from ksim_rl.config import plugins, upstream
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.run_cfg import without_env_size

MODULE, NAME = "ksim_rl.conf", "train"
RUN_AGAIN, RUN_CONFIG = "run_again", "config.yaml"


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


def register() -> None:
    """Let Hydra find other packages' configs, and store the groups' choices, the tasks and their training defaults.

    The last go to the groups `task`, `task/training` (what holds for any objective) and `task/objective_training`.
    """
    _register(plugins.named())


@cache
def _register(_named: tuple[str, ...]) -> None:
    Plugins.instance().register(DeclaredConfigs)
    envs.register_configs()
    store = partial(upstream.store_config, package="_global_")
    choices.store_choices()
    for name in envs.names():
        store("task/training", name, partial(choices.training_defaults, name))
        for objective in algorithms.names():
            make = partial(choices.objective_defaults, name, objective)
            store("task/objective_training", f"{name}_{objective}", make)
    upstream.quicken()


def register_run(folder: Path) -> bool:
    """Store the config that a run left in its folder as the primary config `RUN_AGAIN`; False if there is none.

    Raises:
        ValueError: if its file is not YAML, or its env has another seed than the run.
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
    plain = without_env_size({str(key): value for key, value in tree.items()})
    ConfigStore.instance().store(name=RUN_AGAIN, node={"defaults": ["launch", "_self_"], **plain})
    return True


class DeclaredConfigs(SearchPathPlugin):
    """Lets Hydra find the configs that other packages declare (see `ksim_rl.config.plugins`); ours come first."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append them."""
        for origin, package in plugins.conf_packages():
            search_path.append(provider=f"ksim_rl.conf:{origin}", path=f"pkg://{package}")
