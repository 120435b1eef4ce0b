"""Sees each thing that a process does to files below a folder before it happens, and can make it fail.

Python tells an audit hook about each file that is opened, made, renamed or deleted, and an exception of the hook is
what the caller gets; flushes to the disk are wrapped. A hook cannot be removed: install it in forked processes only.
"""

from __future__ import annotations

import errno
import os
import resource
import sys
from collections.abc import Callable
from pathlib import Path

_PATHS = {"open": 0, "os.mkdir": 0, "os.rename": 1, "os.remove": 0, "os.rmdir": 0, "os.truncate": 0}
_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


def on_each(folder: Path, act: Callable[[str, str], None]) -> None:
    """Call `act(kind, path)` before each change below `folder`; kinds: open, mkdir, rename, remove, rmdir, fsync."""
    below = str(folder)
    busy: list[bool] = []

    def tell(kind: str, path: str) -> None:
        if busy or not path.startswith(below):
            return
        busy.append(True)
        try:
            act(kind, path)
        finally:
            busy.pop()

    def hook(event: str, arguments: tuple) -> None:
        at = _PATHS.get(event)
        if at is None or not isinstance(arguments[at], str | bytes | os.PathLike):
            return
        if event == "open" and not (arguments[2] & _WRITES):
            return
        tell(event.removeprefix("os."), os.fsdecode(arguments[at]))

    fsync = os.fsync

    def told_fsync(file: int) -> None:
        tell("fsync", os.readlink(f"/proc/self/fd/{file}"))
        fsync(file)

    os.fsync = told_fsync
    sys.addaudithook(hook)


def no_space(path: str) -> OSError:
    """Return what a full disk answers."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


def limit_files(size: int) -> None:
    """Let no file of this process grow beyond a size: whatever Python or a library in C writes then fails."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
