"""These checks refuse values by a ValueError, which names the field, the value and the valid ones."""

import argparse
import difflib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from numbers import Real
from typing import NoReturn

# Warp, MuJoCo and torch's kernels count in 32 bits.
MOST_COUNT = 2**31 - 1
# Errors that well-formed data of a file raises where it lacks a part, or has one of another kind.
MISFITS = (LookupError, TypeError, AttributeError, ArithmeticError)


def near(name: str, choices: Iterable[str]) -> str:
    """Return a hint with the choices that resemble `name`, or with all of them when none does."""
    choices = sorted(set(choices))
    # Case is ignored: names of classes are often typed in lower case.
    lower = {choice.lower(): choice for choice in choices}
    close = [
        lower[match] for match in difflib.get_close_matches(name.lower(), lower, n=3, cutoff=0.6)
    ]
    # A name that was cut short differs from each in too much.
    close = (
        close
        or [choice for choice in choices if name and choice.lower().startswith(name.lower())][:3]
    )
    if close:
        return f"did you mean {' or '.join(repr(choice) for choice in close)}?"
    if not choices:
        return "there is none to choose from"
    # Twenty at most: the message is one line.
    shown = ", ".join(choices[:20])
    return f"valid: {shown}" + (f", ... ({len(choices)} in all)" if len(choices) > 20 else "")


def unknown_name(kind: str, name: str, choices: Iterable[str]) -> ValueError:
    """Build the error for a name that matches nothing, with the near names."""
    return ValueError(f"unknown {kind} {name!r}: {near(name, choices)}")


def check_known(kind: str, name: str, choices: Collection[str]) -> None:
    """Refuse a name that is none of `choices`, by the error of `unknown_name`."""
    if name not in choices:
        raise unknown_name(kind, name, choices)


@contextmanager
def naming(where: str, *errors: type[Exception]) -> Iterator[None]:
    """Put `where` before a ValueError of this block; given other `errors`, make one of these, and of these alone."""
    kinds = errors or (ValueError,)
    try:
        yield
    except kinds as error:
        raise ValueError(f"{where}: {error}") from error


def check_in_range(
    field: str,
    value: object,
    *,
    low: float | None = None,
    high: float | None = None,
    low_open: bool = False,
) -> None:
    """Refuse a number that is not finite or lies outside `[low, high]` (`(low, high]` with `low_open`)."""
    # As intervals are written: a bound that is not part of the interval has a round bracket.
    start = "(-inf" if low is None else f"[{low}"
    if low_open:
        start = start.replace("[", "(")
    end = "inf)" if high is None else f"{high}]"
    bounds = f"{start}, {end}"
    # bool is a kind of number in Python.
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ValueError(f"{field}={value!r}: expected a number in {bounds}")
    # Not as a float, which would take a large int for its neighbour.
    if isinstance(value, int):
        number = value
    else:
        number = float(value)
    below = low is not None and (number <= low if low_open else number < low)
    # NaN differs from itself.
    if (
        number != number
        or abs(number) == float("inf")
        or below
        or (high is not None and number > high)
    ):
        raise ValueError(f"{field}={value!r}: expected a finite number in {bounds}")


def check_count(field: str, value: object, *, low: int = 1, high: int = MOST_COUNT) -> None:
    """Refuse a value that is no whole number, or one outside `[low, high]`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < low:
        raise ValueError(f"{field}={value!r}: expected a whole number >= {low}")
    if value > high:
        raise ValueError(f"{field}={value!r}: expected a whole number of at most {high}")


def check_choice(field: str, value: object, choices: Iterable[object]) -> None:
    """Refuse a value that is none of `choices`; the error has the near ones."""
    choices = list(choices)
    if value not in choices:
        hint = near(str(value), [str(choice) for choice in choices])
        raise ValueError(f"{field}={value!r}: {hint}")


def check_pair(
    field: str, value: object, *, low: float | None = None, high: float | None = None
) -> None:
    """Refuse a range that is not a pair of finite, ordered numbers within `[low, high]`."""
    # YAML gives lists where Python has tuples.
    if not isinstance(value, (tuple, list)) or len(value) != 2:
        raise ValueError(f"{field}={value!r}: expected a pair (low, high)")
    for index, number in enumerate(value):
        check_in_range(f"{field}[{index}]", number, low=low, high=high)
    if value[0] > value[1]:
        raise ValueError(f"{field}={value!r}: low exceeds high; expected a pair (low, high)")


class OneLineParser(argparse.ArgumentParser):
    """Refuses the arguments of a command by a ValueError too, which `ksim-rl` says in one line."""

    def error(self, message: str) -> NoReturn:
        """Raise it, for `ksim-rl` to report."""
        raise ValueError(f"{message} (see {self.prog} --help)")
