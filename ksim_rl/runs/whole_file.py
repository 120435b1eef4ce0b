"""This module writes files that appear under their own names only once they are whole."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

WRITING = ".writing-"  # what a name begins with until then; a run that goes on deletes what a crash left


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes `path` at the end; where writing fails, `path` stays as it was."""
    temporary = path.with_name(f"{WRITING}{secrets.token_hex(4)}-{path.name}")  # another writer has another
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise


def write_whole(path: Path, text: str) -> None:
    """Write a text into a file that appears once it is whole."""
    with whole_file(path) as temporary:
        temporary.write_text(text)
