"""Finds and imports plug-ins: other packages' tasks, terms, robots, transforms, networks and algorithms.

An installed package declares its parts in its pyproject.toml, and is then known to every command:

    [project.entry-points."ksim_rl.tasks"]
    my_robots = "my_robots.tasks"      # a module, or a package whose modules are all read

    [project.entry-points."ksim_rl.algorithms"]
    my_robots = "my_robots.learning"

    [project.entry-points."ksim_rl.conf"]
    my_robots = "my_robots.conf"       # a package of YAML files, laid out like ksim_rl/conf

Any other package is a plug-in where the user names it: `--plugin my_package` for one command, the environment variable
`KSIM_RL_PLUGINS=my_package,other` for all. One that is not installed is looked for in the folders, absolute paths, of
`KSIM_RL_PLUGIN_PATH`; `--plugin` takes it from the working directory too, and says so. Its modules are imported at
once, each `Task` and `Algorithm` at the top level of one is registered, its subpackage `conf`, where there is one,
holds YAML files, and configs may name its classes as `_target_`. A name in a run folder or a checkpoint is never a
reason to import anything.
"""

import importlib
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

TASKS = "ksim_rl.tasks"
CONF = "ksim_rl.conf"
ALGORITHMS = "ksim_rl.algorithms"
VARIABLE = "KSIM_RL_PLUGINS"
PATH_VARIABLE = "KSIM_RL_PLUGIN_PATH"

# Plug-ins that were named, in that order, and packages that were only allowed.
_named: list[str] = []
_allowed: set[str] = set()


@cache
def declared(group: str) -> tuple[EntryPoint, ...]:
    """Return the entry points of a group, by name."""
    # Sorted, since the order of installed packages is the file system's.
    return tuple(sorted(entry_points(group=group), key=lambda point: (point.name, point.value)))


def allow_package(name: str) -> None:
    """Let configs build the classes of another package (its top-level name)."""
    _allowed.add(name)


def load_from_here(names: Sequence[str], *, note: Callable[[str], None]) -> None:
    """Load plug-ins as `load` does, and also from the working directory, as `--plugin` asks; `note` reports that.

    Only a package that is nowhere else puts the folder on Python's path, behind all else.
    """
    here = os.getcwd()
    _extend_path()
    for name in names:
        package = name.strip().partition(".")[0]
        # Found elsewhere: the working directory must not take its place.
        if package in sys.modules or find_spec(package) is not None:
            continue
        if PathFinder.find_spec(package, [here]) is not None:
            note(f"--plugin {name}: taken from {here}, where Python finds modules from now on")
            # For child processes too, whose working directory is another.
            os.environ[PATH_VARIABLE] = os.pathsep.join([*_folders(), here])
            break
    load(names)


def load(names: Sequence[str]) -> None:
    """Import the plug-ins that a command or a caller names, and the plug-ins of `KSIM_RL_PLUGINS`.

    Processes that this one starts load the same plug-ins, as the environment variable takes up the names. A ValueError
    names one that cannot be imported.
    """
    _extend_path()
    # First the plug-ins of the environment: a command adds to them.
    wanted = [*os.environ.get(VARIABLE, "").split(","), *names]
    for name in dict.fromkeys(name.strip() for name in wanted if name.strip()):
        if name in _named:
            continue
        # Told with the error, as a missing folder is the usual reason.
        fix = f"correct the name, install the package, or put its folder into {PATH_VARIABLE}"
        _import(f"plug-in {name!r}", name, fix)
        _named.append(name)
    if _named:
        # Children load the same plug-ins by this.
        os.environ[VARIABLE] = ",".join(_named)


def environment() -> dict[str, str]:
    """Return the environment variables that let a child process find this one's plug-ins, by absolute paths."""
    folders = _folders()
    for name in sorted({name.split(".")[0] for name in _named} | _allowed):
        module = sys.modules.get(name)
        # One that was only allowed may not be imported yet.
        if module is None or module.__spec__ is None:
            continue
        # A package has places, and of a module that is one file this is the place.
        places = module.__spec__.submodule_search_locations or [module.__spec__.origin]
        folders += [str(Path(place).absolute().parent) for place in places if place]
    found = {PATH_VARIABLE: os.pathsep.join(dict.fromkeys(folders))}
    if _named:
        return {**found, VARIABLE: ",".join(_named)}
    return found


def _folders() -> list[str]:
    """Return the folders of `KSIM_RL_PLUGIN_PATH`; relative ones would lead into whatever folder the user stands in."""
    return [
        folder
        for folder in os.environ.get(PATH_VARIABLE, "").split(os.pathsep)
        if os.path.isabs(folder)
    ]


def _extend_path() -> None:
    # Behind everything else, so that no plug-in hides an installed package.
    sys.path += [folder for folder in _folders() if folder not in sys.path]


def named() -> tuple[str, ...]:
    """Return the plug-ins that were named so far, in that order."""
    return tuple(_named)


def declared_packages() -> frozenset[str]:
    """Return the top-level packages that declare an entry point of ours; nothing is imported."""
    # Names of entry points alone: importing would run their code.
    points = (point.module for group in (TASKS, CONF, ALGORITHMS) for point in declared(group))
    return frozenset(name.split(".")[0] for name in points)


def packages() -> frozenset[str]:
    """Return the top-level packages whose classes configs may name, beside our own."""
    return declared_packages() | _allowed | {name.split(".")[0] for name in _named}


def hint(package: str) -> str:
    """Return the advice to a user who trusts a package, so that configs may name its classes."""
    return f"If you trust {package!r}, add --plugin {package} (in Python: plugins=[{package!r}])"


def check_remembered(names: Sequence[str]) -> None:
    """Refuse a run whose plug-ins were not named, allowed or installed here; the ValueError has the flag that does."""
    for name in names:
        package = str(name).split(".")[0]
        if package not in packages():
            raise ValueError(
                f"this run was made with the plug-in {name!r}, which is not loaded. {hint(str(name))}"
            )


def modules(group: str) -> Iterator[tuple[str, ModuleType]]:
    """Import the modules that a group of entry points names, and the plug-ins, with the origin of each for messages."""
    for point in declared(group):
        if point.dist is None:
            owner = "an unknown package"
        else:
            owner = point.dist.name
        origin = f"entry point {point.name} = {point.value!r} of {owner}"
        # Importing registers the tasks and algorithms at a module's top level.
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
        # A plug-in of one file has no folder for configs.
        if "__path__" in vars(sys.modules[name]) and find_spec(f"{name}.conf") is not None:
            yield name, f"{name}.conf"


def _import(origin: str, name: str, fix: str) -> list[ModuleType]:
    """Import a module and, if it is a package, those directly in it."""
    try:
        module = importlib.import_module(name)
        inside = vars(module).get("__path__", ())
        # `__main__` would run the plug-in's program.
        found = (info.name for info in pkgutil.iter_modules(inside) if info.name != "__main__")
        return [module, *(importlib.import_module(f"{name}.{child}") for child in found)]
    except Exception as error:
        raise ValueError(
            f"{origin} cannot be loaded: {type(error).__name__}: {error}; {fix}"
        ) from error
