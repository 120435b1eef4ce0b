"""This module opens every file that may be a stranger's: a regular file of limited size, or a refusal by name."""

import os
import stat
from pathlib import Path
from typing import BinaryIO

# Bytes that a file of a kind may have.
MOST_DATA_BYTES = 2**30  # motions, recordings, motor models, tables of metrics


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
    return file


def read_bytes(path: Path, *, limit: int, follows_links: bool = False) -> bytes:
    """Read a file that `open_regular` opens."""
    with open_regular(path, limit=limit, follows_links=follows_links) as file:
        try:
            return file.read(os.fstat(file.fileno()).st_size)  # Python takes memory for all that is asked for
        except OSError as error:
            raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
