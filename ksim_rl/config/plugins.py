"""This module finds and imports plug-ins: other packages' tasks, terms, robots, transforms, networks and algorithms.

An installed package declares what it has in its pyproject.toml, and is then known to every command:

    [project.entry-points."ksim_rl.tasks"]
    my_robots = "my_robots.tasks"      # a module, or a package whose modules are all read

    [project.entry-points."ksim_rl.algorithms"]
    my_robots = "my_robots.learning"

    [project.entry-points."ksim_rl.conf"]
    my_robots = "my_robots.conf"       # a package of YAML files, laid out like ksim_rl/conf

Any other package is a plug-in where the user names it: `--plugin my_package` for one command, the environment variable
`KSIM_RL_PLUGINS=my_package,other` for all. Its modules are imported at once, each `Task` and `Algorithm` at the top
level of one is registered, its subpackage `conf`, where there is one, holds YAML files, and configs may name its
classes as `_target_`. What a run folder or a checkpoint says is never a reason to import anything.
"""

import importlib
import os
import pkgutil
import sys
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from types import ModuleType

TASKS, CONF, ALGORITHMS = "ksim_rl.tasks", "ksim_rl.conf", "ksim_rl.algorithms"
VARIABLE = "KSIM_RL_PLUGINS"

_named: list[str] = []
_allowed: set[str] = set()


@cache
def declared(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, by name."""
    return tuple(sorted(entry_points(group=group), key=lambda point: (point.name, point.value)))


def allow_package(name: str) -> None:
    """Let configs build the classes of another package (its top-level name)."""
    _allowed.add(name)


def load(names: Sequence[str]) -> None:
    """Import the plug-ins that a command or a caller names, with those of `KSIM_RL_PLUGINS`.

    Packages of the working directory are found too, after installed ones. Processes that this one starts load the same
    plug-ins, as the environment variable takes up the names. A ValueError names one that cannot be imported.
    """
    wanted = [*os.environ.get(VARIABLE, "").split(","), *names]
    for name in dict.fromkeys(name.strip() for name in wanted if name.strip()):
        if name in _named:
            continue
        if os.getcwd() not in sys.path and "" not in sys.path:
            sys.path.append(os.getcwd())
        _import(f"plug-in {name!r}", name, "correct the name, or install the package")
        _named.append(name)
    if _named:
        os.environ[VARIABLE] = ",".join(_named)


def named() -> tuple[str, ...]:
    """Return the plug-ins that were named so far, in that order."""
    return tuple(_named)


def declared_packages() -> frozenset[str]:
    """Return the top-level packages that declare an entry point of ours; nothing is imported."""
    points = (point.module for group in (TASKS, CONF, ALGORITHMS) for point in declared(group))
    return frozenset(name.split(".")[0] for name in points)


def packages() -> frozenset[str]:
    """Return the top-level packages whose classes configs may name, beside our own."""
    return declared_packages() | _allowed | {name.split(".")[0] for name in _named}


def hint(package: str) -> str:
    """Return what a user who trusts a package does so that configs may name its classes."""
    return f"If you trust {package!r}, add --plugin {package} (in Python: plugins=[{package!r}])"


def check_remembered(names: Sequence[str]) -> None:
    """Refuse a run whose plug-ins nobody named, allowed or installed here; the ValueError has the flag that does."""
    for name in names:
        package = str(name).split(".")[0]
        if package not in packages():
            raise ValueError(
                f"this run was made with the plug-in {name!r}, which is not loaded. {hint(str(name))}"
            )


def modules(group: str) -> Iterator[tuple[str, ModuleType]]:
    """Import the modules that a group of entry points names, and the plug-ins, with the origin of each for messages."""
    for point in declared(group):
        owner = "an unknown package" if point.dist is None else point.dist.name
        origin = f"entry point {point.name} = {point.value!r} of {owner}"
        for module in _import(origin, point.module, "mend or uninstall that package"):
            yield origin, module
    for name in _named:
        for module in _import(f"plug-in {name!r}", name, "mend that package"):
            yield f"plug-in {name!r}", module


def conf_packages() -> Iterator[tuple[str, str]]:
    """Yield the packages with YAML configs: an origin for messages, and the package."""
    for point in declared(CONF):
        yield point.name, point.module
    for name in _named:
        if "__path__" in vars(sys.modules[name]) and find_spec(f"{name}.conf") is not None:
            yield name, f"{name}.conf"


def _import(origin: str, name: str, fix: str) -> list[ModuleType]:
    """Import a module and, if it is a package, those directly in it."""
    try:
        module = importlib.import_module(name)
        inside = vars(module).get("__path__", ())
        found = (info.name for info in pkgutil.iter_modules(inside) if info.name != "__main__")
        return [module, *(importlib.import_module(f"{name}.{child}") for child in found)]
    except Exception as error:
        raise ValueError(f"{origin} cannot be loaded: {type(error).__name__}: {error}; {fix}") from error
