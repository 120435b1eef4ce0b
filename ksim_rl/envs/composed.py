"""Applies Hydra overrides to the config trees of tasks; imported late, as Hydra loads slowly."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from ksim_rl.config import upstream
from ksim_rl.config.overrides import check_overrides
from ksim_rl.config.trees import Tree

_CONFIG = "ksim_rl_env"
_MODULE = "ksim_rl.envs"

MakeTree = Callable[[str], Tree]


@cache
def register(names: tuple[str, ...], make_tree: MakeTree) -> None:
    """Store the tree that is made of each task's name in Hydra's config group `task`."""
    for name in names:
        upstream.store_config("task", name, partial(make_tree, name))
    ConfigStore.instance().store(name=_CONFIG, node={"defaults": [{"task": "???"}, "_self_"]})


def with_overrides(name: str, make_tree: MakeTree, overrides: Sequence[str]) -> Any:
    """Return the tree of a registered task with overrides applied; a ValueError names the one that is not valid."""
    # Our own check first: it names near fields, which Hydra's errors do not.
    check_overrides({"task": make_tree(name)}, overrides)
    # Its sibling `initialize` reads the source around each frame of the stack to find out who calls.
    with initialize_config_module(_MODULE, version_base="1.3"):
        try:
            composed = compose(config_name=_CONFIG, overrides=[f"task={name}", *overrides])
        except ConfigCompositionException as error:
            # Hydra's own text says where, and its cause says what is wrong.
            raise ValueError(f"{error}: {error.__cause__}") from error
    return OmegaConf.to_container(composed.task, resolve=True)
