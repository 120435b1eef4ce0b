"""Reads the files of an exported folder, which may be a stranger's: as data, of limited size."""

import json
import math
import os
import re
import stat
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np

from ksim_rl.export.standalone.description import Export

Array = np.ndarray
# 1 GiB: a file of more, or one that unpacks to more, is refused before it fills the memory.
MOST_BYTES = 2**30
# Of export.json, which says what the ONNX files read.
FORMAT = 2
# Far more than an export has of anything that is counted, such as actions or steps of a delay.
MOST = 1_000_000
# Of a period: a robot that listens less often could not be stopped in time.
MOST_SECONDS = 10.0
# Tags that make MuJoCo load other files or code, and "<!", which begins an XML entity.
LEAVES_THE_FOLDER = re.compile(rb"<!|<\s*(include|extension|plugin|attach|model)\b", re.IGNORECASE)
# Attributes of MJCF that name a file or a folder.
PATHS = re.compile(r"\b(?:file\w*|content_type|\w*dir)\s*=\s*[\"']([^\"']*)[\"']")
# A JSON object. Its entries have no type of their own, as readers go on from one to the next.
Json: TypeAlias = dict[str, Any]


def read(path: Path, most: int = MOST_BYTES) -> bytes:
    """Return the bytes of a regular file of limited size; links, pipes and devices are refused."""
    # No link is followed, and a pipe does not block until something is written to it.
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW), "rb") as file:
            # Asked of the open file, not of its path, which could be another file by then.
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode) or about.st_size > most:
                raise ValueError(f"{path}: expected a regular file of at most {most} bytes")
            return file.read(most)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error


def read_json(path: Path) -> Export:
    """Return an export's metadata; a ValueError names the fault of the file."""
    # 64 MiB, far more than the largest description.
    content = read(path, 2**26)
    try:
        # Deep nesting raises RecursionError in the parser.
        found = json.loads(content, parse_float=_number, parse_constant=_number)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None
    if not isinstance(found, dict) or found.get("format") not in (1, FORMAT):
        raise ValueError(f"{path}: expected the metadata of an export, of format {FORMAT}")
    if found["format"] == 1:
        raise ValueError(
            f"{path}: format 1, of before observations were traced: write it once more with `ksim-rl export RUN`; the "
            "folder's own runner.py still runs it"
        )
    # Entries are not looked at here: the reader of a size or a number checks it.
    return cast(Export, found)


def _number(text: str) -> float:
    """Return a number of a JSON file; NaN and Infinity, which no export writes, would be limits without effect."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]}: expected finite numbers")
    return value


def read_arrays(path: Path) -> dict[str, Array]:
    """Return the arrays of numbers of an .npz file."""
    # Refuses links and pipes; the content is read below.
    read(path)
    try:
        with zipfile.ZipFile(path) as archive:
            # Deflate packs zeros a thousandfold: the sum of unpacked sizes is what will be allocated.
            if sum(entry.file_size for entry in archive.infolist()) > MOST_BYTES:
                raise ValueError(f"{path}: unpacked larger than {MOST_BYTES} bytes")
            return {
                entry.filename.removesuffix(".npy"): _array(archive, entry)
                for entry in archive.infolist()
            }
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for a damaged file
        raise ValueError(f"{path}: not arrays of numbers: {error}") from None


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Array:
    """Return one array, once its header claims no more than the file holds."""
    # Header first: numpy allocates the whole shape before it reads.
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        headers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        if version not in headers:
            raise ValueError(f"{entry.filename}: version {version} of the format")
        shape, _, dtype = headers[version](file)
        claimed = math.prod(shape) * dtype.itemsize
        # Floats, signed and unsigned integers, booleans. Objects would be unpickled, which runs code.
        if dtype.kind not in "fiub" or min(shape, default=0) < 0 or claimed > entry.file_size:
            raise ValueError(f"{entry.filename}: {shape} of {dtype}")
    # Opened again, since a compressed entry is read from its beginning.
    with archive.open(entry) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def check_closed(path: Path) -> None:
    """Refuse a model that takes in others, or names anything but regular files of its own folder."""
    folder = path.parent
    text = read(path, 2**28)
    if found := LEAVES_THE_FOLDER.search(text):
        raise ValueError(f"{path}: {found.group().decode()!r}: an exported model stands for itself")
    # Meshes, textures and height fields: resolved, so that ".." and links do not lead out.
    for name in PATHS.findall(text.decode(errors="replace")):
        named = folder / name
        inside = named.resolve().is_relative_to(folder.resolve())
        # "&" could spell a path by an entity, which this search does not see.
        if not inside or os.path.isabs(name) or "&" in name:
            raise ValueError(f"{path}: {name!r} is outside of the folder")
        # Also refuses pipes, links and huge files in the places of meshes.
        if named.exists() and not named.is_dir():
            read(named)


def check_count(what: str, value: float, most: int = MOST) -> int:
    """Return a whole number of 0 to a million, or to another limit, or refuse it."""
    # bool is a subclass of int in Python.
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
        raise ValueError(
            f"export.json: {what} is {str(value)[:40]}: expected a whole number of 0 to {most}"
        )
    return value


@contextmanager
def refusing(folder: Path) -> Iterator[None]:
    """Make a ValueError, which names the folder, of whatever a stranger's file makes a library raise."""
    try:
        yield
    except Exception as error:
        why = str(error)
        if isinstance(error, ValueError) and str(folder) in why:
            raise
        if not isinstance(error, ValueError):
            why = f"{type(error).__name__}: {why}"
        raise ValueError(f"{folder}: {why}") from error


def check_seconds(what: str, value: float) -> float:
    """Return a duration of at most `MOST_SECONDS`, or refuse it."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0.0 < value <= MOST_SECONDS:
        raise ValueError(
            f"{what} is {str(value)[:40]}: expected more than 0 and at most {MOST_SECONDS:g} s"
        )
    return float(value)


def check_parent(option: str, path: Path) -> None:
    """Refuse a file that cannot be written since its folder is not there."""
    if not path.parent.is_dir():
        raise ValueError(f"{option} {path}: there is no folder {path.parent}")


def measurements(meta: Export) -> list[Json]:
    """Return the sources of the inputs of `obs.onnx`: none for a policy that reads only pictures."""
    if meta["obs"] is None:
        return []
    return meta["obs"]["measurements"]


def lacking(left_out: Sequence[str]) -> str:
    """Return the end of a return's line, which names the rewards that are not in it; nothing where all are."""
    names = [str(name) for name in left_out]
    rewards = [name.removeprefix("rewards.") for name in names if name.startswith("rewards.")]
    return f"  without {', '.join(rewards)}" if rewards else ""


def as_text(figures: list[dict[str, float]], meta: Export) -> str:
    """Return mean and spread of the figures of episodes, a line each."""
    lines = []
    for name in figures[0]:
        values = [one[name] for one in figures]
        note = lacking(meta.get("left_out", ())) if name == "return" else ""
        lines.append(f"{name:<40} {np.mean(values):12.4f} +- {np.std(values):.4f}{note}")
    return "\n".join(lines)
