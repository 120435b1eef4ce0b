"""This module finds the algorithms by name: ours, those of plug-ins, and those that a program registers itself."""

import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType

from ksim_rl.checks import unknown_name
from ksim_rl.config import plugins
from ksim_rl.objectives import AlgorithmCfg
from ksim_rl.trainers.algorithm import Algorithm

PACKAGE = "ksim_rl.algorithms"
_found: dict[str, tuple[str, Algorithm]] = {}
_read: set[str] = set()


def register(algorithm: Algorithm, *, origin: str = "a call of register") -> None:
    """Add an algorithm; once more is the same.

    Raises:
        ValueError: if another one has its name.
    """
    first, known = _found.setdefault(algorithm.name, (origin, algorithm))
    if known is not algorithm:
        raise ValueError(
            f"two algorithms are called {algorithm.name!r}: in {first} and in {origin}; rename one"
        )


def names() -> list[str]:
    """Return the names of the algorithms."""
    return sorted(_algorithms())


def algorithm(name: str) -> Algorithm:
    """Return an algorithm by name.

    Raises:
        ValueError: if there is none of this name, with the near names.
    """
    found = _algorithms()
    if name not in found:
        raise unknown_name("algorithm", name, found)
    return found[name][1]


def serving(cfg: type[AlgorithmCfg]) -> Algorithm:
    """Return the algorithm whose settings these are: that of the class itself, or of its nearest base.

    Raises:
        ValueError: if there is none.
    """
    by_class = {algorithm.cfg: algorithm for _, algorithm in _algorithms().values()}
    for base in cfg.__mro__:
        if base in by_class:
            return by_class[base]
    raise ValueError(
        f"objective is a {cfg.__name__}, which no algorithm serves: inherit from the settings of one of "
        f"{', '.join(names())}, or register an `Algorithm` with cfg={cfg.__name__}"
    )


def _algorithms() -> dict[str, tuple[str, Algorithm]]:
    for origin, module in (*_own_modules(), *plugins.modules(plugins.ALGORITHMS)):
        if module.__name__ not in _read:
            for value in vars(module).values():
                if isinstance(value, Algorithm):
                    register(value, origin=origin)
            _read.add(module.__name__)
    return _found


def _own_modules() -> Iterator[tuple[str, ModuleType]]:
    for info in pkgutil.iter_modules(importlib.import_module(PACKAGE).__path__, f"{PACKAGE}."):
        if info.ispkg:
            yield info.name, importlib.import_module(info.name)
