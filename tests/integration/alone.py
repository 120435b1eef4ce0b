"""Runs a program with a few installed packages, as if the others were not there."""

import importlib.metadata
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
OURS = "ksim_rl"

# Refuses modules by name, before anything that is installed is asked for them.
REFUSAL = """
import sys

class Absent:
    def __init__(self, names):
        self.names = names

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

sys.meta_path.insert(0, Absent(frozenset(%r)))
"""


def run_with(packages: Sequence[str], program: str, *, without: Sequence[str] = ()) -> str:
    """Return what a Python program prints that can import these packages, what they require, and ours.

    Modules named in `without` are absent, too, whoever requires them. Fails where the program does.
    """
    absent = sorted(_modules_of_others(_with_requirements(packages)) | set(without))
    done = subprocess.run(
        [sys.executable, "-c", REFUSAL % (absent,) + textwrap.dedent(program)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


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
