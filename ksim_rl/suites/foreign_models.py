"""The models of suites come from packages of others: where those lie, and which of their elements are not drawn."""

from importlib.util import find_spec
from pathlib import Path

# Geoms and sites of this group are not drawn unless a viewer is asked to.
HIDDEN_GROUP = 4


def package_folder(package: str, *, of: str, extra: str) -> Path:
    """Return where a package of models lies, which is not imported; a ValueError says how to install it."""
    found = find_spec(package.replace("-", "_"))
    if found is None or not found.submodule_search_locations:
        raise ValueError(
            f"{of} need the models of the package {package}: pip install 'ksim_rl[{extra}]'"
        )
    return Path(found.submodule_search_locations[0])
