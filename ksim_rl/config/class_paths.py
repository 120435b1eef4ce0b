"""Spells classes in configs by public paths, and finds the class of a path, also of one that 0.1 wrote."""

import importlib
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from ksim_rl.checks import near
from ksim_rl.config import plugins
from ksim_rl.config.trees import Plain

TARGET = "_target_"
OWN = "ksim_rl"

_PLANAR = ("cheetah_run", "hopper", "walker", "walker_amp", "walker_motion")
_CONTROL_SUITE = ("cartpole", "pendulum_swingup", "reacher")
MOVED = {
    "ksim_rl.envs.actuators": "ksim_rl.scene.actuators",
    "ksim_rl.envs.mdp": "ksim_rl.mdp",
    "ksim_rl.envs.objects": "ksim_rl.scene.objects",
    "ksim_rl.envs.robots": "ksim_rl.scene.robots",
    "ksim_rl.envs.sensors": "ksim_rl.scene.sensors",
    "ksim_rl.envs.tasks": "ksim_rl.tasks",
    "ksim_rl.envs.terrains": "ksim_rl.scene.terrains",
    "ksim_rl.envs.transforms": "ksim_rl.transforms",
    **{f"ksim_rl.tasks.{task}": "ksim_rl.tasks.planar" for task in _PLANAR},
    **{f"ksim_rl.tasks.{task}": "ksim_rl.tasks.control_suite" for task in _CONTROL_SUITE},
}
"""Paths of 0.1 and where their classes are now, applied in turn; else a class is found by its package's exports."""
MOVED_CLASSES = {"ksim_rl.tasks.planar.PoseDistance": "ksim_rl.mdp"}
"""Classes that have left a module which is still there, by their earlier paths, and where they are now."""
GONE = {("SimCfg", "deterministic")}
"""Fields that earlier versions wrote into configs, by their class, and that nothing needs any more."""

REPLACED = {
    "GeneralActuator": "a <general> actuator in the robot's MJCF",
    "RandomCommandCurriculum": "ksim_rl.mdp.CommandRangesByLevel",
}
"""Classes of 0.1 that are gone, and what to use instead."""


def public_path(cls: type) -> str:
    """Return the shortest path that leads to a class, so that files which move inside a room change no config."""
    parts = cls.__module__.split(".")
    if parts[0] == OWN:
        # From the room downwards: the first package that exports the class is the public one.
        for end in range(2, len(parts)):
            package = ".".join(parts[:end])
            if vars(sys.modules[package]).get(cls.__qualname__) is cls:
                return f"{package}.{cls.__qualname__}"
    # Other packages promise no exports: the module is the path.
    return f"{cls.__module__}.{cls.__qualname__}"


def find(
    target: object,
    path: str,
    *,
    kind: str,
    accepts: Callable[[type], bool],
    besides: frozenset[str] = frozenset(),
) -> type:
    """Import the class that a `_target_` names, if its package is ours, a plug-in's or one of `besides`.

    A ValueError, with the near names, refuses other packages, and a class that is not there or that `accepts` declines.
    It says where the target stands in the config (`path`), and the `kind` of class that was looked for.
    """
    module_name, _, class_name = str(target).rpartition(".")
    where = f"{path}.{TARGET}={target!r}"
    package = module_name.split(".")[0]
    # Importing runs code, so the package is checked before anything is imported.
    allowed = plugins.packages() | {OWN} | besides
    if package not in allowed:
        raise ValueError(
            f"{where}: only classes of these packages are built: {', '.join(sorted(allowed))}. {plugins.hint(package)}"
        )
    names: list[str] = []
    declined: Any = None
    # The path as written, then the packages that may export the class now.
    for candidate in _modules(module_name, class_name):
        try:
            module = importlib.import_module(candidate)
        except ModuleNotFoundError as error:
            # A package of the path that is missing is tried elsewhere; a missing dependency is the real
            # error.
            if not candidate.startswith(str(error.name)):
                raise ValueError(
                    f"{where}: {candidate} needs {error.name!r}, which is not installed"
                ) from error
            continue
        # A re-exported class of a third package is not ours to build.
        found = vars(module).get(class_name)
        if isinstance(found, type) and accepts(found) and found.__module__.split(".")[0] in allowed:
            return found
        declined = declined or found
        # For the error: the names that would have been accepted.
        names += [
            name
            for name, value in vars(module).items()
            if isinstance(value, type) and accepts(value)
        ]
    if package == OWN and class_name in REPLACED:
        raise ValueError(f"{where}: {class_name} is gone: use {REPLACED[class_name]}")
    if isinstance(declined, type) and not accepts(declined):
        raise ValueError(
            f"{where}: {class_name} is a class, and no {kind}: name the {kind} that makes one, as docs/learning.md "
            "does for networks"
        )
    if not names:
        raise ValueError(f"{where}: no module {module_name!r} with a {kind}")
    raise ValueError(f"{where}: no {kind} {class_name!r} there: {near(class_name, names)}")


def _modules(name: str, class_name: str) -> list[str]:
    """Return the module of a class's path and, for ours, where it may have moved to: the packages above it."""
    if name.split(".")[0] != OWN:
        return [name]
    moved = name
    # In turn: a path may have moved twice.
    for old, new in MOVED.items():
        if f"{moved}.".startswith(f"{old}."):
            moved = moved.replace(old, new, 1)
    moved = MOVED_CLASSES.get(f"{moved}.{class_name}", moved)
    # Longest first, so that a module counts before the packages above it.
    parts = moved.split(".")
    candidates = [name]
    for end in range(len(parts), 1, -1):
        candidates.append(".".join(parts[:end]))
    return list(dict.fromkeys(candidates))


def foreign(tree: Plain) -> Iterator[str]:
    """Yield the `_target_`s in a tree that are neither ours nor TorchRL's."""
    entries: Iterable[Plain] = ()
    if isinstance(tree, dict):
        package = str(tree.get(TARGET, OWN)).split(".")[0]
        if package not in (OWN, "torchrl"):
            yield str(tree[TARGET])
        entries = tree.values()
    elif isinstance(tree, list):
        entries = tree
    for entry in entries:
        yield from foreign(entry)


def loading_notes(tree: Plain) -> list[str]:
    """Return one line for each foreign package of a tree whose classes a later command does not find by itself."""
    notes: dict[str, str] = {}
    # Plug-ins that are declared or named are found by any later command.
    known = plugins.declared_packages() | {name.split(".")[0] for name in plugins.named()}
    for target in foreign(tree):
        package = target.split(".")[0]
        # Only this process knows its main module and its local classes.
        if package == "__main__" or "<locals>" in target:
            notes[target] = (
                f"this run names {target}, which no other process can import: `ksim-rl` will not be able to load its "
                "checkpoints; move the class to a module of a package"
            )
        elif package not in known:
            notes.setdefault(
                package,
                f"this run names {target}: to load its checkpoints, give `ksim-rl` --plugin {package}",
            )
    return list(notes.values())
