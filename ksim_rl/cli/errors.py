"""This module turns an error into one line for the user and an exit code."""

import os
import sys
import traceback

REFUSED, FAILED = 2, 3


def report(error: Exception, *, about: str = "") -> int:
    """Say an error in one line on stderr and return its exit code.

    Its traceback comes first where `KSIM_RL_TRACEBACK` asks for it, or where no message can explain it.
    """
    explained = isinstance(error, (ValueError, RuntimeError, OSError)) and not isinstance(
        error, NotImplementedError
    )
    if os.environ.get("KSIM_RL_TRACEBACK") or not explained:
        traceback.print_exception(error)
    text = " ".join(str(error).split())
    say(f"error: {about}{text if explained and text else f'{type(error).__name__}: {text}'}")
    return REFUSED if isinstance(error, ValueError) else FAILED


def say(text: str) -> None:
    """Print one line of the program's own on stderr."""
    print(f"ksim-rl: {text}", file=sys.stderr)
