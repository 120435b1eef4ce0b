"""Readies the text of a URDF file for MuJoCo: meshes are found in ROS packages, and fixed links stay.

MuJoCo's own reading of URDF knows no packages, and melts links without joints into their parents, so that a robot whose
base is free to move becomes a part of the world. Its extension of URDF, `<mujoco><compiler .../></mujoco>`, says
otherwise; where a file has one, that stays as its author wrote it.
"""

import html
import os
import re
from collections.abc import Iterator
from pathlib import Path

_ROBOT = re.compile(r"<robot\b[^>]*>")
_EXTENSION = re.compile(r"<mujoco\b")
_COLLISION = re.compile(r"<collision\b")
_MESH = re.compile(
    r"(?P<start><mesh\b[^>]*?\bfilename\s*=\s*)(?P<quote>[\"'])(?P<name>.*?)(?P=quote)", re.DOTALL
)
_PACKAGE = re.compile(r"(?:package|model)://(?P<package>[^/]*)/+(?P<path>.*)", re.DOTALL)


def is_urdf(text: str) -> bool:
    """Return whether a text describes a robot in URDF."""
    return _ROBOT.search(text) is not None and "<worldbody" not in text


def ready_urdf(text: str, folder: Path) -> str:
    """Return the text of a URDF file of `folder` with the paths of its meshes, and the line numbers of before.

    `package://name/path` is looked for in the folders above the file: as `name/path`, or as `path` in a folder called
    `name`. A ValueError names a mesh whose package is in none of them.
    """
    if not _EXTENSION.search(text):
        # Without shapes that collide, those that are drawn are all that is known of the links.
        if _COLLISION.search(text):
            discards = "true"
        else:
            discards = "false"
        # Paths of meshes stay whole, and links that are fixed stay bodies.
        compiler = f'<compiler strippath="false" fusestatic="false" discardvisual="{discards}"/>'
        text = _ROBOT.sub(lambda found: f"{found[0]}<mujoco>{compiler}</mujoco>", text, count=1)
    # As it is called, since links may be what holds packages together.
    folder = Path(os.path.abspath(folder))

    def found_mesh(match: re.Match[str]) -> str:
        # XML may escape characters of a path.
        path = _mesh_path(html.unescape(match["name"].strip()), folder)
        return f"{match['start']}{match['quote']}{html.escape(path)}{match['quote']}"

    # On the same lines, so that errors name the author's.
    return _MESH.sub(found_mesh, text)


def packages_of(text: str, folder: Path) -> list[Path]:
    """Return the folders of the packages that a URDF text of `folder` takes meshes from."""
    found: dict[Path, None] = {}
    # Meshes with plain paths belong to no package.
    for mesh in _MESH.finditer(text):
        in_package = _PACKAGE.fullmatch(html.unescape(mesh["name"].strip()))
        if in_package is None:
            continue
        for of_package in _folders_of(in_package["package"], Path(os.path.abspath(folder))):
            if (of_package / in_package["path"]).is_file():
                found[of_package] = None
                break
    return list(found)


def _folders_of(package: str, folder: Path) -> Iterator[Path]:
    """Yield the folders that may be a package's, from a file's own folder upwards."""
    # The package is a folder beside one above the file, or is itself above it.
    for above in (folder, *folder.parents):
        yield above / package
        if above.name == package:
            yield above


def _mesh_path(name: str, folder: Path) -> str:
    """Return the path under which MuJoCo finds a mesh that a file of `folder` names."""
    in_package = _PACKAGE.fullmatch(name)
    if in_package is None:
        return name.removeprefix("file://")
    package = in_package["package"]
    path = in_package["path"]
    for of_package in _folders_of(package, folder):
        if (of_package / path).is_file():
            return str(of_package / path)
    raise ValueError(
        f"mesh {name!r}: no folder above the file has {package}/{path}: put the package {package!r} beside the "
        "file's, or write the mesh's path in place of package://"
    )
