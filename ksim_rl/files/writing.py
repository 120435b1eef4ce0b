"""Writes every file that a command leaves: whole or not at all, and never through links.

A folder may come from a stranger, with links in the place of files: `RUN/export/README.md` may be the user's `.bashrc`.
So a link, a file that has other names (hard links) and anything that is no file are refused by name. A file appears
under its own name once it is whole.
"""

import fcntl
import os
import secrets
import shutil
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, BinaryIO

# A name begins with this until its file is whole; who writes there next deletes leftovers of a crash.
WRITING = ".writing-"


def open_streams() -> None:
    """Open each of the three standard streams that is closed, on nothing.

    Else the next file that is opened takes the place of one, such as a checkpoint into which a library in C prints its
    errors; and libraries in Python call methods of `sys.stderr`.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            # The lowest number that is free, which is this one.
            os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, closefd=False))


def check_place(option: str, path: Path | None, *, is_folder: bool) -> None:
    """Refuse a place in which no folder or no file can be made, before any work is done for it.

    `option` is how the user has named it, such as "--output"; without a `path` nothing is checked. The ValueError names
    the file that lies in the way.
    """
    if path is None:
        return
    if is_folder and path.exists() and not path.is_dir():
        raise ValueError(f"{option} {path}: a file lies there: name a new folder")
    if not is_folder and path.is_dir():
        raise ValueError(f"{option} {path}: a folder lies there: name a new file")
    for above in path.parents:
        # A file has no `..` below it either, so that the first that is there decides.
        if os.path.lexists(above):
            if not above.is_dir():
                raise ValueError(f"{option} {path}: {above} is a file: name a place in a folder")
            return


def check_own(path: Path) -> None:
    """Refuse a path at which something else lies than a file of this folder alone."""
    check_name(path)
    with suppress(FileNotFoundError):
        _check_status(path, os.lstat(path))


def check_name(path: Path) -> None:
    """Refuse a path with bytes that are no UTF-8: libraries that write files abort there, or write elsewhere."""
    # Surrogate escapes stand for bytes that are no UTF-8.
    if os.fsencode(path) != str(path).encode(errors="replace"):
        raise ValueError(
            f"{path.absolute()}: bytes that are no UTF-8, with which nothing is written: rename the folder"
        )


def check_links(folder: Path, *, below: Sequence[str]) -> None:
    """Refuse a folder in which something, at its top or in the folders `below`, leads out: a run writes there.

    These are links to other folders, files with other names (hard links), pipes and devices.
    """
    check_name(folder)
    inside = folder.resolve()
    # Only folders that a run writes into; others, such as a user's data, may hold anything.
    walked = (
        os.path.join(root, name)
        for own in below
        for root, *names in os.walk(folder / own)
        for name in sum(names, [])
    )
    for path in map(Path, (*folder.iterdir(), *walked)):
        # Links inside of the folder are harmless. By os: a link to itself is an error of another kind for `resolve`.
        if path.is_symlink() and not Path(os.path.realpath(path)).is_relative_to(inside):
            raise ValueError(
                f"{path}: a link that leads out of the run folder, and a run writes only into its own"
            )
        # Hard links, pipes and devices in the place of files.
        if not path.is_symlink() and not path.is_dir():
            check_own(path)


def check_folder(folder: Path, *, below: Path) -> None:
    """Refuse a folder of a user's folder `below` that is reached by a link; `below` itself may be one."""
    # `below` may be a link of the user's own, such as to a larger disk; nothing under it may.
    check_name(folder)
    reached = below
    for name in folder.relative_to(below).parts:
        reached /= name
        if reached.is_symlink():
            raise ValueError(
                f"{reached}: a link, and nothing is written through links: delete it, or name another folder"
            )


def make_folder(folder: Path, *, below: Path) -> None:
    """Make a folder of a user's folder `below`, which `check_folder` passes."""
    check_folder(folder, below=below)
    folder.mkdir(parents=True, exist_ok=True)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes `path` at the end; where writing fails, `path` stays as it was.

    A ValueError refuses a `path` that leads elsewhere, see `check_own`.
    """
    check_own(path)
    # In the same folder: only within one file system does a file replace another at one moment.
    # Another writer has another.
    temporary = path.with_name(f"{WRITING}{secrets.token_hex(4)}-{path.name}")
    try:
        with named(path):
            yield temporary
            # Readers see the old file or the new one, never a part.
            os.replace(temporary, path)
    # Also for Ctrl-C.
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a text or bytes into a file that appears once it is whole."""
    if isinstance(content, str):
        data = content.encode()
    else:
        data = content
    with whole_file(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def whole_folder(folder: Path, *, below: Path) -> Iterator[Path]:
    """Give an empty folder to fill, whose files move to `folder` at the end; others stay there.

    Where filling it fails, nothing of `folder` has changed, and it is not there if it was not. A ValueError refuses
    links, in the folders from `below` on and in the place of the files.
    """
    make_folder(folder, below=below)
    try:
        with unfinished_folder(folder) as temporary:
            yield temporary
            # Files of subfolders too.
            files = [path for path in sorted(temporary.rglob("*")) if path.is_file()]
            targets = [folder / path.relative_to(temporary) for path in files]
            # All places are checked before the first file moves.
            for target in targets:
                check_folder(target.parent, below=below)
                check_own(target)
            for path, target in zip(files, targets, strict=True):
                make_folder(target.parent, below=below)
                os.replace(path, target)
    finally:
        with suppress(OSError):
            folder.rmdir()  # only where nothing is in it


@contextmanager
def unfinished_folder(folder: Path) -> Iterator[Path]:
    """Give a new folder in `folder`, which is deleted at the end, and after a kill by who comes here next."""
    # The next writer cleans up after a crash.
    _remove_abandoned(folder)
    temporary = folder / f"{WRITING}{secrets.token_hex(4)}"
    temporary.mkdir()
    try:
        with _held(temporary), named(folder):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def open_new(path: Path) -> BinaryIO:
    """Open a new file to write bytes piece by piece; a ValueError where anything lies in its place."""
    check_name(path)
    try:
        # Exclusively, so that no link is followed.
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    except FileExistsError:
        raise ValueError(f"{path}: it is there already: name another folder") from None
    return os.fdopen(number, "wb")


def open_own(path: Path) -> IO[str]:
    """Open a file to read and write, which is made where there is none, and is refused as `check_own` refuses it."""
    check_name(path)
    try:
        # Not through a link, and without waiting for the reader of a pipe.
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
    except OSError:
        check_own(path)  # which names a link
        raise
    try:
        # The open file is asked, so that nothing can be put in its place in between.
        _check_status(path, os.fstat(number))
        return os.fdopen(number, "r+")
    except BaseException:
        os.close(number)
        raise


def _check_status(path: Path, about: os.stat_result) -> None:
    if stat.S_ISLNK(about.st_mode):
        what = "a link"
    elif not stat.S_ISREG(about.st_mode):
        what = "no regular file"
    # A hard link would change a file of another folder, too.
    elif about.st_nlink > 1:
        what = f"a file with {about.st_nlink} names (hard links)"
    else:
        return
    raise ValueError(
        f"{path}: {what}, and only files of this folder alone are written: delete it, or choose another"
    )


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Name the path in errors that name none: a full disk answers a write without any name."""
    try:
        yield
    except OSError as error:
        # An error that names its file needs no help.
        if error.errno is None or error.filename is not None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder that is being filled, so that others see that its process lives."""
    # A folder can be locked like a file.
    number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        with suppress(OSError):  # some file systems have no locks
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(number)


def _remove_abandoned(folder: Path) -> None:
    """Delete the leftovers of processes that were killed while they filled a folder."""
    for entry in folder.glob(f"{WRITING}*"):
        # A link is not followed, and not deleted either: it is none of ours.
        if entry.is_symlink() or not entry.is_dir():
            continue
        with suppress(OSError):
            number = os.open(entry, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                # Fails where the process that fills the folder lives: then the folder stays.
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(entry, ignore_errors=True)
            finally:
                os.close(number)
