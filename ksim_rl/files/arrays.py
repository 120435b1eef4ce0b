"""Reads archives of arrays (`.npz`), whose headers may claim more than the file or the memory holds."""

import io
import math
import zipfile
from pathlib import Path

import numpy as np

from ksim_rl.files.reading import MOST_DATA_BYTES, read_bytes

MOST_ARRAYS = 1000
SUFFIX = ".npy"


def read_arrays(
    path: Path, *, limit: int = MOST_DATA_BYTES, follows_links: bool = True
) -> dict[str, np.ndarray]:
    """Return the arrays of an archive, which have `limit` bytes at most; a ValueError says why one is refused.

    Their sizes are computed from their headers before memory is taken for them. Arrays of objects, which are pickles,
    are refused.
    """
    # Read as a whole: the file cannot change between header and data.
    return arrays_of(read_bytes(path, limit=limit, follows_links=follows_links), limit=limit)


def arrays_of(content: bytes, *, limit: int = MOST_DATA_BYTES) -> dict[str, np.ndarray]:
    """Return the arrays of the contents of an archive; see `read_arrays`."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            if len(entries) > MOST_ARRAYS:
                raise ValueError(f"it has {len(entries)} arrays, more than {MOST_ARRAYS}")
            # Sizes after unpacking, which a small archive may make huge.
            if sum(entry.file_size for entry in entries) > limit:
                raise ValueError(f"its arrays are larger than {limit} bytes")
            return {
                entry.filename.removesuffix(SUFFIX): _read_array(archive, entry)
                for entry in entries
            }
    except ValueError:
        raise
    # Zipfile, its compressions and numpy's parser of headers raise a dozen kinds.
    except Exception as error:
        what = f"{type(error).__name__} {error}"
        raise ValueError(f"no archive of arrays: {' '.join(what.split())}") from error


def _read_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    # Header first: numpy would allocate the claimed shape before it reads.
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{entry.filename}: a format of arrays that is not known, {version}")
        if version == (1, 0):
            reads = np.lib.format.read_array_header_1_0
        else:
            reads = np.lib.format.read_array_header_2_0
        shape, in_columns, dtype = reads(file)
        # Unpickling runs code of the file.
        if dtype.hasobject:
            raise ValueError(f"{entry.filename}: an array of objects, which are pickles")
        wanted = math.prod(shape) * dtype.itemsize
        # Dimensions below zero would make a small product of a large shape.
        if min(shape, default=0) < 0 or wanted > entry.file_size:
            raise ValueError(
                f"{entry.filename}: its header claims {wanted} bytes, and it has {entry.file_size}"
            )
        content = file.read(wanted)
    if len(content) != wanted:
        raise ValueError(
            f"{entry.filename}: {len(content)} bytes, where its header claims {wanted}"
        )
    # A copy, since an array over bytes cannot be written.
    return (
        np.frombuffer(content, dtype=dtype).reshape(shape, order="F" if in_columns else "C").copy()
    )
