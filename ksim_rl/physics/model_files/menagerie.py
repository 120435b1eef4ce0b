"""Finds the files of menagerie robots by name, in a folder or in the package that downloads them."""

import os
from pathlib import Path

from ksim_rl.checks import near


def model_path(name: str) -> Path:
    """Return the file of a robot: "unitree_go1" (its scene), or "unitree_go1/go1" (one of its entry points).

    Looks under the folder that the environment variable MENAGERIE_ROOT names, else in the cache of the package
    `mujoco-menagerie`, which downloads a robot on first use.
    """
    robot, _, entry = name.partition("/")
    root = os.environ.get("MENAGERIE_ROOT")
    if root:
        return _in_folder(Path(root), robot, entry)
    return _from_package(robot, entry)


def _in_folder(root: Path, robot: str, entry: str) -> Path:
    if not (root / robot).is_dir():
        if root.is_dir():
            found = [path.name for path in root.iterdir() if path.is_dir()]
        else:
            found = []
        raise ValueError(
            f"menagerie model {robot!r} is not under MENAGERIE_ROOT={root}: {near(robot, found)}; copy its "
            "folder there, or unset MENAGERIE_ROOT to download it with the package mujoco-menagerie"
        )
    stem = entry or "scene"
    path = root / robot / f"{stem}.xml"
    if not path.is_file():
        found = [path.stem for path in (root / robot).glob("*.xml")]
        raise ValueError(
            f"menagerie model {robot!r} has no entry point {stem!r}: {near(stem, found)}"
        )
    return path


def _from_package(robot: str, entry: str) -> Path:
    try:
        import mujoco_menagerie
    except ImportError:
        raise ValueError(
            f"menagerie model {robot!r} is not here: with a network, `pip install mujoco-menagerie` (it downloads the "
            "model on first use); without one, copy the folder and set MENAGERIE_ROOT to its parent"
        ) from None
    try:
        return mujoco_menagerie.get(robot).xml(entry or None)
    except LookupError as error:
        raise ValueError(f"menagerie: {error}") from None
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise ValueError(
            f"menagerie model {robot!r} could not be downloaded ({error}): with a network, try again; without one, "
            "copy its folder from github.com/google-deepmind/mujoco_menagerie and set MENAGERIE_ROOT to its parent"
        ) from None
