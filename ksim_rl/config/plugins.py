"""Other packages' tasks, terms and configs, found through the entry points that they declare.

In the package's pyproject.toml:

    [project.entry-points."ksim_rl.tasks"]
    my_robots = "my_robots.tasks"      # a module, or a package whose modules are all read

    [project.entry-points."ksim_rl.algorithms"]
    my_robots = "my_robots.learning"   # the same

    [project.entry-points."ksim_rl.conf"]
    my_robots = "my_robots.conf"       # a package of YAML files, laid out like ksim_rl/conf

Each `Task` or `Algorithm` at the top level of such a module is registered. Declaring any of them also lets configs name
the package's dataclasses (terms, robots, transforms) as `_target_`: who may be installed may also be built.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType

TASKS, ALGORITHMS, CONF = "ksim_rl.tasks", "ksim_rl.algorithms", "ksim_rl.conf"


@cache
def declared(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, by name."""
    return tuple(sorted(entry_points(group=group), key=lambda point: (point.name, point.value)))


def packages() -> frozenset[str]:
    """Return the top-level packages that declare an entry point of ours; nothing is imported."""
    return frozenset(
        point.module.split(".")[0] for group in (TASKS, ALGORITHMS, CONF) for point in declared(group)
    )


def modules(group: str) -> Iterator[tuple[str, ModuleType]]:
    """Import the modules that a group of entry points names, with the origin of each for messages.

    Raises:
        ValueError: if one cannot be imported; the message names the package.
    """
    for point in declared(group):
        origin = f"entry point {point.name} = {point.value!r} of {_distribution(point)}"
        try:
            module = importlib.import_module(point.module)
            for name in _modules(module):
                yield origin, importlib.import_module(name)
        except Exception as error:
            raise ValueError(
                f"{origin} cannot be loaded: {type(error).__name__}: {error}; mend or uninstall that package"
            ) from error


def _modules(module: ModuleType) -> list[str]:
    inside = getattr(module, "__path__", None)
    children = (
        [] if inside is None else [info.name for info in pkgutil.iter_modules(inside, f"{module.__name__}.")]
    )
    return [module.__name__, *children]


def _distribution(point: EntryPoint) -> str:
    return "an unknown package" if point.dist is None else point.dist.name
