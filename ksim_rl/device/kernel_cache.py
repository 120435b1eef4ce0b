"""Mends Warp's cache, whose files a full disk, a crash or a copy may have left cut."""

import shutil
from functools import cache
from pathlib import Path

from ksim_rl.device import upstream
from ksim_rl.terminal import show

ADVICE = "delete it, or set WARP_CACHE_PATH to another folder"


@cache
def mend_damages() -> None:
    """Let Warp compile modules again that it cannot read in its cache."""
    upstream.watch_loads(_remove)


def _remove(folder: Path, error: Exception, attempt: int) -> None:
    """Delete the folder of a module that cannot be read; a RuntimeError says what to do where that does not help."""
    why = " ".join(str(error).split())
    if attempt > 1:
        raise RuntimeError(
            f"Warp's cache: {folder} cannot be read or written: {why}; {ADVICE}"
        ) from error
    # A damaged cache has many, and hundreds of lines would hide all else.
    if folder.exists() and folder.parent not in _said:
        _said.add(folder.parent)
        show(
            f"warning: Warp's cache {folder.parent} is damaged ({folder.name}: {why}): what cannot be read is "
            "compiled again",
            to_stderr=True,
        )
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:  # another process mends it, too
        return
    except OSError as refusal:
        raise RuntimeError(
            f"Warp's cache: {folder} cannot be read ({why}), nor deleted ({refusal.strerror}); {ADVICE}"
        ) from error


_said: set[Path] = set()
