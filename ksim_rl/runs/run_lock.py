"""Lets one process at a time write a run folder."""

import errno
import fcntl
import itertools
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import IO, Any

from ksim_rl.files.reading import open_regular
from ksim_rl.files.writing import open_own

LOCK = ".lock"
MOST_LETTERS = 1000
# The errors of file systems without locks, as some clusters have them.
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def locked(folder: Path, *, note: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of a run folder; a ValueError says which process has it, and a note whose it was that has died."""
    try:
        file = _take(folder)
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise
        note(
            f"warning: {folder} cannot be locked ({error.strerror}): see that no other process writes it"
        )
        yield
        return
    try:
        holder = file.read(MOST_LETTERS)
        if holder:
            note(
                f"{folder}: its lock was left by {_described(holder)}, which has ended; this process takes it over"
            )
        me = {
            "pid": os.getpid(),
            "host": socket.gethostname(),
            "since": f"{datetime.now():%Y-%m-%d %H:%M:%S}",
        }
        _write(file, json.dumps(me))
        yield
    finally:
        # Removed while it is held, so that no process takes a file that is no longer there for the lock.
        with suppress(OSError):
            (folder / LOCK).unlink()
        file.close()


def is_locked(folder: Path) -> bool:
    """Whether a living process writes a run folder."""
    try:
        with open_regular(folder / LOCK, limit=MOST_LETTERS) as file:
            return not try_lock(file)
    except (ValueError, OSError):  # there is none, it is none of ours, or there can be none
        return False


def _take(folder: Path) -> IO[str]:
    for attempt in itertools.count():
        file = open_own(folder / LOCK)
        try:
            if try_lock(file):
                with suppress(FileNotFoundError):  # its holder may have removed it meanwhile
                    if os.path.samestat(os.fstat(file.fileno()), os.stat(folder / LOCK)):
                        return file
            elif (holder := file.read(MOST_LETTERS)) or attempt == 20:
                raise ValueError(
                    f"{folder}: {_described(holder)} writes this run: wait for it, or end it"
                )
            else:
                # Another looks whether it is locked, or is about to write its name.
                time.sleep(0.05)
        except BaseException:
            file.close()
            raise
        file.close()
    raise AssertionError


def try_lock(file: IO[Any]) -> bool:
    """Lock an open file, and return False where another process, or another opening of the file, has the lock."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _write(file: IO[str], text: str) -> None:
    file.seek(0)
    file.truncate()
    file.write(text)
    file.flush()


def _described(holder: str) -> str:
    try:
        known = json.loads(holder)
        return f"process {int(known['pid'])} on {known['host']!r}, begun {known['since']!r},"
    except (ValueError, KeyError, TypeError):
        return "another process"
