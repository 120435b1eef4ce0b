"""Turns an error into one line for the user and an exit code."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ksim_rl.terminal import printable, show, show_traceback

REFUSED = 2
FAILED = 3


def report(error: Exception, *, about: str = "") -> int:
    """Say an error in one line on stderr and return its exit code.

    Its traceback comes first where `KSIM_RL_TRACEBACK` asks for it, or where no message can explain it.
    """
    # Python's own message is often empty.
    if isinstance(error, MemoryError):
        error = OSError(f"out of memory: {error}" if str(error) else "out of memory")
    # Imported here, so that mistyped commands answer at once.
    from ksim_rl.device import compiler_caches

    # Messages of compilers are long, and name no way out.
    if (line := compiler_caches.explained(error)) is not None:
        error = RuntimeError(line).with_traceback(error.__traceback__)
    # These kinds are raised with messages for users; any other is a fault of ours.
    explained = isinstance(error, (ValueError, RuntimeError, OSError)) and not isinstance(
        error, NotImplementedError
    )
    if os.environ.get("KSIM_RL_TRACEBACK") or not explained:
        show_traceback(error)
    notes = getattr(error, "__notes__", ())  # where in the config it was, for instance
    text = " ".join(" ".join((str(error), *notes)).split())
    say(f"error: {about}{text if explained and text else f'{type(error).__name__}: {text}'}")
    # ValueError means that nothing was started: another code than a failed run's.
    if isinstance(error, ValueError):
        return REFUSED
    return FAILED


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt as SIGINT does, so that holders of files and folders put them in order."""

    def interrupt(number: int, _frame: object) -> None:
        raise KeyboardInterrupt(number)

    # Only the main thread may set handlers of signals.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def interruption(stopped: KeyboardInterrupt) -> signal.Signals:
    """Return which signal it was."""
    # SIGTERM comes with its number, Ctrl-C without.
    if stopped.args:
        return signal.Signals(stopped.args[0])
    return signal.SIGINT


def say(text: str) -> None:
    """Print one line of the program's own on stderr, and which of several ranks says it."""
    # Several ranks share a terminal.
    if os.environ.get("WORLD_SIZE", "1") != "1" and "RANK" in os.environ:
        rank = f"rank {os.environ['RANK']}: "
    else:
        rank = ""
    show(f"ksim-rl: {rank}{printable(text)}", to_stderr=True)
