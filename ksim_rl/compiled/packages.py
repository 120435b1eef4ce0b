"""Tells a user's packages from libraries, whose code keeps no Python values that a step depends on."""

import functools
import importlib.metadata
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

OURS = "ksim_rl"
# Their transforms and modules are parts of envs, too.
_FRAMEWORKS = frozenset({"torch", "torchrl", "tensordict"})


def package_of(module: str | None) -> str:
    """Return the package at the top of a module's name."""
    return (module or "").partition(".")[0]


@functools.cache
def is_library(package: str) -> bool:
    """Whether a package at the top is ours, Python's own or installed: then its code is not looked into.

    A package of the user may be installed as well: who looks has to except those that the user's parts come from.
    """
    # The cheap tests first: this is asked for each class and function.
    if package == OURS or package in sys.stdlib_module_names:
        return True
    spec = getattr(sys.modules.get(package), "__spec__", None)
    places = [
        *(getattr(spec, "submodule_search_locations", None) or ()),
        getattr(spec, "origin", None) or "",
    ]
    if any("site-packages" in place or "dist-packages" in place for place in places):
        return True
    # Installed elsewhere, such as by `pip install --target`.
    return any(parent in _installed_into() for place in places for parent in Path(place).parents)


@functools.cache
def _installed_into() -> frozenset[Path]:
    """Return the folders that installers have put packages into, wherever these are on the path.

    A project that lies in a folder of its own, though it is installed as editable, is not in one of them.
    """
    folders: set[Path] = set()
    for distribution in importlib.metadata.distributions():
        # Installers write this file; a project that is only on the path lacks it.
        if distribution.read_text("INSTALLER") is not None:
            folders.add(Path(str(distribution.locate_file(""))))
    return frozenset(folders)


def packages_of(parts: Iterable[Any]) -> frozenset[str]:
    """Return the packages that some functions and classes of objects come from, without ours and Python's."""
    packages = {package_of(getattr(part, "__module__", None)) for part in parts}
    return frozenset(packages - {OURS} - sys.stdlib_module_names - _FRAMEWORKS)
