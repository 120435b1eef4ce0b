"""Finds the algorithms by name: ours, plug-ins, and any that a program registers itself."""

import importlib
import pkgutil

from ksim_rl.checks import check_known
from ksim_rl.config import plugins
from ksim_rl.objectives import AlgorithmCfg
from ksim_rl.trainers.algorithm import Algorithm

PACKAGE = "ksim_rl.algorithms"
_found: dict[str, tuple[str, Algorithm]] = {}
_read: set[str] = set()


def register(algorithm: Algorithm, *, origin: str = "a call of register") -> None:
    """Add an algorithm; adding it again does nothing, and another one of its name is a ValueError."""
    # Only another object is a conflict: a plug-in and the program may both add the same one.
    first, known = _found.setdefault(algorithm.name, (origin, algorithm))
    if known is not algorithm:
        raise ValueError(
            f"two algorithms are called {algorithm.name!r}: in {first} and in {origin}; rename one"
        )


def names() -> list[str]:
    """Return the names of the algorithms."""
    return sorted(_algorithms())


def algorithm(name: str) -> Algorithm:
    """Return an algorithm by name."""
    found = _algorithms()
    check_known("algorithm", name, found)
    return found[name][1]


def serving(cfg: type[AlgorithmCfg]) -> Algorithm:
    """Return the algorithm whose settings these are: by the class itself, or by its nearest base."""
    by_class = {algorithm.cfg: algorithm for _, algorithm in _algorithms().values()}
    for base in cfg.__mro__:
        if base in by_class:
            return by_class[base]
    raise ValueError(
        f"objective is a {cfg.__name__}, which no algorithm serves: inherit from the settings of one of "
        f"{', '.join(names())}, or register an `Algorithm` with cfg={cfg.__name__}"
    )


def _algorithms() -> dict[str, tuple[str, Algorithm]]:
    inside = pkgutil.iter_modules(importlib.import_module(PACKAGE).__path__, f"{PACKAGE}.")
    ours = ((info.name, importlib.import_module(info.name)) for info in inside if info.ispkg)
    for origin, module in (*ours, *plugins.modules(plugins.ALGORITHMS)):
        if module.__name__ not in _read:
            for value in vars(module).values():
                if isinstance(value, Algorithm):
                    register(value, origin=origin)
            _read.add(module.__name__)
    return _found
