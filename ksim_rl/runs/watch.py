"""Watches the folder that a run writes, and the threads of its loggers."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path


def watch(run_folder: Path, *, holds: str, note: Callable[[str], None]) -> Callable[[], None]:
    """Return a check that raises OSError once the folder, or the file in it, is gone; read-only is noted once."""
    begun = run_folder.stat()
    said = []

    def check() -> None:
        try:
            # The same folder, and not another one of the same name.
            ours = os.path.samestat(begun, run_folder.stat()) and (run_folder / holds).exists()
        except OSError:
            ours = False
        if not ours:
            raise OSError(
                f"{run_folder}: deleted or moved while this run wrote it: nothing more can be saved, so the run ends"
            )
        # Told once, not at each check.
        if not said and not os.access(run_folder, os.W_OK):
            said.append(True)
            note(
                f"warning: {run_folder} has become read-only: nothing is saved until it can be written again"
            )

    return check


@contextmanager
def threads_that_fail(note: Callable[[str], None]) -> Iterator[None]:
    """Say in one line that a thread failed, such as the writer of TensorBoard's file; the run goes on."""

    def say(failed: threading.ExceptHookArgs) -> None:
        name = getattr(failed.thread, "name", "a thread")
        note(f"warning: {name} ended: {failed.exc_type.__name__}: {failed.exc_value}")

    # Other threads of the program keep their own way of failing afterwards.
    previous = threading.excepthook
    threading.excepthook = say
    try:
        yield
    finally:
        threading.excepthook = previous
