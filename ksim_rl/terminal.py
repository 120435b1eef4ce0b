"""Prints text without the control characters that a terminal obeys; names from files may hold them."""

import sys
import traceback
import warnings
from pathlib import Path

MOST_LETTERS = 10_000  # of a line


def printable(text: str) -> str:
    r"""Return a text as one line that a terminal shows and does not obey.

    Control codes such as ESC, line ends and marks that turn the direction of writing become spaces. Bytes of a file's
    name that are no UTF-8 are written as `\xff`.
    """
    return "".join(map(_letter, text[:MOST_LETTERS]))


def show(text: str, *, end: str = "\n", to_stderr: bool = False) -> None:
    """Print lines of text, each as `printable` has it; a command prints in no other way."""
    lines = "\n".join(map(printable, text.split("\n")))
    print(lines, end=end, file=sys.stderr if to_stderr else sys.stdout, flush=True)


def show_traceback(error: BaseException) -> None:
    """Print where an error was raised, on stderr."""
    show("".join(traceback.format_exception(error)), end="", to_stderr=True)


def show_warnings_as_lines() -> None:
    """Let warnings of this process be printed as one line each, which names of a model are part of."""

    def one_line(
        message: Warning | str, kind: type[Warning], file: str, line: int, source: str | None = None
    ) -> str:
        return f"{printable(f'{Path(file).name}:{line}: {kind.__name__}: {message}')}\n"

    warnings.formatwarning = one_line


def _letter(letter: str) -> str:
    if letter.isprintable():
        return letter
    # Python's way to carry a byte that is no text.
    if "\udc80" <= letter <= "\udcff":
        return f"\\x{ord(letter) - 0xDC00:02x}"
    return " "
