"""A model that a few words make enormous is refused here, before MuJoCo spends minutes or all memory on it."""

import math
import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path

import mujoco

VARIABLE = "KSIM_RL_LARGEST_MODEL"
LARGEST = 10**8

# By a pattern, because it must find the same tags as MuJoCo's parser in what a stricter one refuses.
_TAG = re.compile(r"<!--.*?-->|<(?P<close>/?)(?P<tag>[A-Za-z_]\w*)(?P<rest>[^<>]*?)(?P<alone>/?)>", re.DOTALL)
_ATTRIBUTE = re.compile(r"(\w+)\s*=\s*[\"']([^\"']*)")
_NUMBER = re.compile(r"[-+]?[0-9.]+(?:[eE][-+]?\d+)?")
_ELEMENTS_OF_A_VERTEX, _NUMBERS_OF_A_CONTACT = 4, 17
_PNG = b"\x89PNG\r\n\x1a\n"


def check_text(text: str, folder: Path, label: str) -> None:
    """Refuse an XML text, with the files that it includes, whose replicas, grids and meshes come to too much."""
    elements, numbers = _count(text, folder, label, ())
    # MuJoCo compares elements with each other.
    _check({f"{elements:,} elements": elements**2, "meshes and height fields": numbers}, label)


def check_spec(spec: mujoco.MjSpec, label: str) -> None:
    """Refuse a spec whose height fields, textures, sensors or user data come to too much."""
    sizes = {"user data": sum(max(0, value) for value in _sizes(spec))}
    for hfield in spec.hfields:
        sizes[f"height field {hfield.name!r}"] = max(hfield.nrow, 0) * max(hfield.ncol, 0)
    for texture in spec.textures:
        faces = 1 if texture.type == mujoco.mjtTexture.mjTEXTURE_2D else 6
        size = max(0, texture.width) * max(0, texture.height) * faces
        sizes[f"texture {texture.name!r}"] = max(size, _pixels(spec, texture.file))
    resolution = {
        camera.name: math.prod(max(1, int(n)) for n in camera.resolution) for camera in spec.cameras
    }
    for sensor in spec.sensors:
        rays = resolution.get(sensor.objname, 1) if sensor.objtype == mujoco.mjtObj.mjOBJ_CAMERA else 1
        values = max(1, sensor.dim, *(int(number) for number in sensor.intprm)) * _NUMBERS_OF_A_CONTACT
        sizes[f"sensor {sensor.name!r}"] = rays * values
    _check(sizes, label)


def _check(sizes: dict[str, int], label: str) -> None:
    given = os.environ.get(VARIABLE, str(LARGEST))
    if not given.isdecimal():
        raise ValueError(f"{VARIABLE}={given!r}: expected a whole number")
    what = max(sizes, key=lambda name: sizes[name])
    if sizes[what] > int(given):
        raise ValueError(
            f"{label}: {what}: about {sizes[what]:.1e} numbers or comparisons, which MuJoCo would spend minutes or all "
            f"memory on; make it smaller, or raise the environment variable {VARIABLE} above that (now {int(given)})"
        )


def _sizes(spec: mujoco.MjSpec) -> Iterator[int]:
    elements = len(spec.bodies) + len(spec.geoms) + len(spec.sites) + len(spec.joints) + 1
    yield spec.nuserdata
    for name in ("nkey", *(name for name in dir(spec) if name.startswith("nuser_"))):
        yield getattr(spec, name) * elements


def _count(text: str, folder: Path, label: str, within: tuple[Path, ...]) -> tuple[int, int]:
    """Return how many elements a text comes to, and how many numbers the surfaces that it builds have."""
    elements = numbers = attachments = 0
    models: list[tuple[int, int]] = []
    times = [1]
    for found in _TAG.finditer(text):
        tag, attributes = found["tag"], dict(_ATTRIBUTE.findall(found["rest"] or ""))
        if tag is None:
            continue
        if found["close"]:
            if tag == "replicate" and len(times) > 1:
                times.pop()
            continue
        elements += times[-1]
        if tag == "replicate" and not found["alone"]:
            times.append(times[-1] * _product(attributes.get("count", "")))
        elif tag == "flexcomp":
            elements += times[-1] * _ELEMENTS_OF_A_VERTEX * _product(attributes.get("count", ""))
        elif tag == "hfield":
            numbers += _product(attributes.get("nrow", "")) * _product(attributes.get("ncol", ""))
        elif tag == "mesh" and "builtin" in attributes:
            numbers += max((abs(n) for n in _numbers(attributes.get("params", ""))), default=0) ** 3
        elif tag == "attach":
            attachments += times[-1]
        elif tag in ("include", "model") and "file" in attributes:
            path = (folder / attributes["file"]).resolve()
            if path in within:
                raise ValueError(f"{label}: <{tag} file={attributes['file']!r}>: the file takes in itself")
            if path.is_file():
                inner = _count(path.read_text(errors="replace"), path.parent, label, (*within, path))
                if tag == "model":
                    models.append(inner)
                else:
                    elements, numbers = elements + inner[0] * times[-1], numbers + inner[1]
    of_one = max(models, default=(0, 0))
    return elements + attachments * of_one[0], numbers + attachments * of_one[1]


def _numbers(text: str) -> list[int]:
    values = [float(number) for number in _NUMBER.findall(text) if number.strip("+-.")]
    return [int(value) if math.isfinite(value) else LARGEST**2 for value in values]


def _product(text: str) -> int:
    return math.prod(max(1, number) for number in _numbers(text))


def _pixels(spec: mujoco.MjSpec, file: str) -> int:
    """Return the pixels that the head of a PNG file says, 0 where there is no such file."""
    for folder in (spec.texturedir, spec.meshdir, ""):
        path = Path(spec.modelfiledir) / folder / file
        if file and path.is_file():
            with open(path, "rb") as opened:
                head = opened.read(24)
            return (
                math.prod(struct.unpack(">II", head[16:])) if head.startswith(_PNG) and len(head) == 24 else 0
            )
    return 0
