"""The programs of an exported folder, as modules."""

import importlib
import sys
from pathlib import Path
from types import ModuleType


def module_of(folder: Path, name: str) -> ModuleType:
    """Return `loop` or `runner` of an exported folder of your own; a stranger's is for `ksim-rl sim2sim`."""
    path = folder / f"{name}.py"
    if not path.is_file():
        raise ValueError(
            f"{folder}: no {name}.py in it: expected a folder that `ksim-rl export` wrote"
        )
    # First, since another `loop` may be installed.
    sys.path.insert(0, str(folder.absolute()))
    return importlib.import_module(name)
