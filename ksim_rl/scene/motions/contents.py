"""Reads the files of motions: each once, whether its hash is asked for first or its arrays."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ksim_rl.files.arrays import arrays_of
from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes


@dataclass(frozen=True, kw_only=True)
class _Known:
    """The hash of a file in a state, told by `stamp`; and its contents, until their arrays have been asked for."""

    stamp: tuple[int, int, int]
    sha256: str
    content: bytes | None


_KNOWN: dict[Path, _Known] = {}


def sha256_of(path: Path) -> str:
    """Return the hash of a file of data; its contents are kept until `motion_arrays` takes them."""
    known = _known(path)
    if known is None:
        known = _read(path)
        _KNOWN[path.absolute()] = known
    return known.sha256


def motion_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a file; a ValueError says why it is none of arrays."""
    known = _known(path)
    if known is None or known.content is None:
        known = _read(path)
    assert known.content is not None
    # Hours of training need the hash alone.
    _KNOWN[path.absolute()] = _Known(stamp=known.stamp, sha256=known.sha256, content=None)
    return arrays_of(known.content, limit=MOST_DATA_BYTES)


def _known(path: Path) -> _Known | None:
    """Return the known content of a file, unless it has changed since."""
    known = _KNOWN.get(path.absolute())
    if known is None or not path.exists() or known.stamp != _stamp(path):
        return None
    return known


def _read(path: Path) -> _Known:
    content = read_bytes(path, limit=MOST_DATA_BYTES, follows_links=True)
    sha256 = hashlib.sha256(content).hexdigest()
    return _Known(stamp=_stamp(path), sha256=sha256, content=content)


def _stamp(path: Path) -> tuple[int, int, int]:
    stat = path.stat()
    return stat.st_ino, stat.st_size, stat.st_mtime_ns
