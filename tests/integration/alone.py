"""Runs a program with a few installed packages, as if the others were not there."""

import importlib.metadata
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
OURS = "ksim_rl"
_BETWEEN = "-- the next program --"

# Lets Python's finders find nothing of these names: then it is as if they were not installed.
REFUSAL = """
import sys

class Without:
    def __init__(self, finder, names):
        self.finder = finder
        self.names = names

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            return None
        return self.finder.find_spec(name, path, target)

absent = frozenset(ABSENT)
assert not absent & set(sys.modules)
sys.meta_path[:] = [Without(finder, absent) for finder in sys.meta_path]
"""


def run_with(packages: Sequence[str], program: str, *, without: Sequence[str] = ()) -> str:
    """Return what a Python program prints that can import these packages, what they require, and ours.

    Modules named in `without` are absent, too, whoever requires them. Fails where the program does.
    """
    absent = sorted(_modules_of_others(_with_requirements(packages)) | set(without))
    done = subprocess.run(
        [sys.executable, "-c", REFUSAL.replace("ABSENT", repr(absent)) + program],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def run_each_with(
    packages: Sequence[str], programs: Sequence[str], *, without: Sequence[str] = ()
) -> list[str]:
    """Return what each program prints; they run as with `run_with`, one after the other in one process.

    A process imports for as long as most programs run: what has been loaded is asked by the first.
    """
    between = f"\nprint({_BETWEEN!r})\n"
    printed = run_with(packages, between.join(programs), without=without)
    return printed.split(f"{_BETWEEN}\n")


def _with_requirements(packages: Sequence[str]) -> set[str]:
    """Return the packages, and what each of them requires on this machine without extras, and so on."""
    found: set[str] = set()
    open_ends = [_spelled(package) for package in packages]
    while open_ends:
        package = open_ends.pop()
        if package in found:
            continue
        try:
            requires = importlib.metadata.requires(package) or ()
        except importlib.metadata.PackageNotFoundError:
            continue  # a requirement of another kind of machine
        found.add(package)
        for requirement in map(Requirement, requires):
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                open_ends.append(_spelled(requirement.name))
    return found


def _modules_of_others(packages: set[str]) -> set[str]:
    modules: set[str] = set()
    for module, owners in importlib.metadata.packages_distributions().items():
        is_given = any(_spelled(owner) in packages for owner in owners)
        if not is_given and module != OURS:
            modules.add(module)
    return modules


def _spelled(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()
