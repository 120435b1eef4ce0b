"""Makes Hydra's store of configs quick to list.

Hydra copies all that it holds whenever it lists a group, which takes half a second with the configs of our tasks, and
`ksim-rl train --help` lists a hundred times. What it loads it copies once more, so the first copy protects nothing.
"""

from typing import Any

from hydra.core.config_store import ConfigNode, ConfigStore


class _Kept(ConfigNode):
    """A stored config that stays the same object in a copy of the store."""

    def __deepcopy__(self, _memo: dict[int, Any]) -> "_Kept":
        return self


def quicken() -> None:
    """Let what is stored now be listed without copies of it."""
    _visit(ConfigStore.instance().repo)


def _visit(folder: dict[str, Any]) -> None:
    for name, entry in folder.items():
        if isinstance(entry, dict):
            _visit(entry)
        elif type(entry) is ConfigNode:
            folder[name] = _Kept(**vars(entry))
