"""Opens every file that may be a stranger's: a regular file of limited size, or a refusal by name."""

import os
import stat
from pathlib import Path
from typing import BinaryIO

# Bytes that a file of a kind may have.
MOST_DATA_BYTES = 2**30  # motions, motor models, meshes and pictures
MOST_TENSOR_BYTES = 4 * 2**30  # of a checkpoint
MOST_TEXT_BYTES = 128 * 2**20  # recordings, tables of metrics
MOST_MODEL_BYTES = 64 * 2**20  # the text of a model
MOST_CONFIG_BYTES = 2**19  # YAML, of which a config of ours has some 20 kB
# A file that takes next to nothing on the disk, and claims more than this, was made to fill memory.
MOST_SPARSE_BYTES = 64 * 2**20
LEAST_SHARE = 0.01


def open_regular(path: Path, *, limit: int, follows_links: bool = False) -> BinaryIO:
    """Open a regular file of at most `limit` bytes, and refuse pipes, devices and, unless it follows them, links."""
    link = 0 if follows_links else os.O_NOFOLLOW
    try:
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | link), "rb")
    except FileNotFoundError as error:
        raise ValueError(f"{path}: missing: {error.strerror}") from error
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
    about = os.fstat(file.fileno())
    if not stat.S_ISREG(about.st_mode):
        file.close()
        raise ValueError(f"{path}: cannot be read: it is no regular file")
    if about.st_size > limit:
        file.close()
        raise ValueError(f"{path}: damaged: longer than the {limit} bytes it may have")
    on_disk = 512 * about.st_blocks  # blocks are counted in this unit, whatever their size is
    if about.st_size > MOST_SPARSE_BYTES and on_disk < LEAST_SHARE * about.st_size:
        file.close()
        raise ValueError(
            f"{path}: damaged: of its {about.st_size} bytes only {on_disk} were ever written"
        )
    return file


def check_regular(path: Path, *, limit: int) -> None:
    """Refuse the files that `open_regular` refuses, except links, for libraries that open a file themselves."""
    open_regular(path, limit=limit, follows_links=True).close()


def read_bytes(path: Path, *, limit: int, follows_links: bool = False) -> bytes:
    """Read a file that `open_regular` opens."""
    with open_regular(path, limit=limit, follows_links=follows_links) as file:
        try:
            # Python takes memory for all that is asked for.
            return file.read(os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
