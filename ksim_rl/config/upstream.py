"""Undocumented interfaces of Hydra that configs use, checked with Hydra 1.3.8 and OmegaConf 2.3.1.

`ConfigStore.store` makes OmegaConf nodes of whatever it is given, which takes most of a second for all of our tasks.
And Hydra copies all that it holds whenever it lists a group, which `ksim-rl train --help` does a hundred times; what it
loads it copies once more, so the first copy protects nothing. So configs are put into its store as nodes that are made
late and not copied. `tests/config/test_upstream.py` names the part that a new version moved.
"""

import re
from collections.abc import Callable
from functools import cache, cached_property

from hydra.core.config_store import ConfigNode, ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import get_yaml_loader

from ksim_rl.config.trees import Tree


class _Kept(ConfigNode):
    """A stored config that stays the same object in a copy of the store."""

    # Hydra copies the store for lookups, which is slow with hundreds of configs.
    def __deepcopy__(self, _memo: dict) -> "_Kept":
        return self


class _Made(_Kept):
    """A stored config that is made when it is loaded first."""

    def __init__(
        self, make: Callable[[], Tree], *, name: str, group: str, package: str | None
    ) -> None:
        self.make = make
        self.name = name
        self.group = group
        self.package = package
        self.provider = None

    # Built on first use: a command needs a few of the configs.
    @cached_property
    def node(self) -> DictConfig:
        return _made(self.make)


@cache
def _made(make: Callable[[], Tree]) -> DictConfig:
    # Not kept in `_Made`: Hydra reads the node of a copy.
    return OmegaConf.create(make())


def store_config(
    group: str, name: str, make: Callable[[], Tree], *, package: str | None = None
) -> None:
    """Store a config in a group; `make` is called for its tree when Hydra first loads it."""
    # Written into the store's folders, since its own method wants the finished tree.
    folder = ConfigStore.instance().repo
    for part in group.split("/"):
        folder = folder.setdefault(part, {})
    folder[f"{name}.yaml"] = _Made(make, name=f"{name}.yaml", group=group, package=package)


def quicken(folder: Tree | None = None) -> None:
    """Let the configs that others stored so far be listed without copies of them."""
    if folder is None:
        folder = ConfigStore.instance().repo
    for name, entry in folder.items():
        if isinstance(entry, dict):
            quicken(entry)
        # Exactly this class: ours are kept already.
        elif type(entry) is ConfigNode:
            folder[name] = _Kept(**vars(entry))


def yaml_resolvers() -> dict[str, list[tuple[str, re.Pattern[str]]]]:
    """Return OmegaConf's rules for kinds of scalars: 1e-3 is a number, and a date is text."""
    return dict(get_yaml_loader().yaml_implicit_resolvers)
