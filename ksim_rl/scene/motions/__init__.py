"""Reference motions that come with the package, by name: `view.motion("walker_walk")`.

Each is an .npz file beside the module that computes it: `python -m ksim_rl.scene.motions.<name>` writes it anew.
"""

from importlib.resources import files
from pathlib import Path


def motion_path(file: str) -> Path:
    """Return where a motion of this name lies in the package or, if there is none of this name, `file` as a path."""
    shipped = Path(str(files(__name__).joinpath(f"{file}.npz")))
    return shipped if shipped.is_file() and shipped.parent == Path(__file__).parent else Path(file)


def motion_names() -> list[str]:
    """Return the names of the motions that come with the package."""
    return sorted(path.stem for path in Path(__file__).parent.glob("*.npz"))
