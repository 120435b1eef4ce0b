"""The ranges of commands that a policy has seen in its training."""

from typing import Literal

import numpy as np

from ksim_rl.export.standalone.description import CommandSpec, Export
from ksim_rl.export.standalone.files import Array, check_count

MOST_OFF = 1e-5
"""By which a command may be beyond its range, of 1 or of the command: float32 holds no more."""


class CommandRange:
    """The numbers of one command, and their ranges."""

    def __init__(self, name: str, spec: CommandSpec) -> None:
        self.name = name
        self.size = check_count(f"commands.{name}.size", spec["size"])
        self.low = self._ends("low", spec, -np.inf)
        self.high = self._ends("high", spec, np.inf)
        if not (self.low <= self.high).all():
            raise ValueError(
                f"export.json: commands.{name}: low {self.low.tolist()}, high {self.high.tolist()}"
            )

    def _ends(self, what: Literal["low", "high"], spec: CommandSpec, otherwise: float) -> Array:
        values = spec.get(what)
        # A command without known bounds, or a folder from before ranges were exported.
        if values is None:
            return np.full(self.size, otherwise)
        try:
            ends = np.array(values, float)
        except (ValueError, TypeError):
            ends = np.zeros(0)
        if ends.shape != (self.size,) or not np.isfinite(ends).all():
            raise ValueError(
                f"export.json: commands.{self.name}.{what} is {str(values)[:40]}: expected {self.size} finite numbers"
            )
        return ends

    def clip(self, values: Array) -> Array:
        """Return the nearest command of the range."""
        return np.clip(values, self.low, self.high)

    def check(self, values: Array) -> None:
        """Raise ValueError for a command that the policy has not seen."""
        given = np.asarray(values, float)
        if given.shape != (self.size,):
            raise ValueError(f"command {self.name!r}: {given.size} numbers: expected {self.size}")
        # Written so that NaN is refused, too.
        fits = np.abs(given - self.clip(given)) <= MOST_OFF * np.maximum(1.0, np.abs(given))
        if not fits.all():
            raise ValueError(
                f"command {self.name!r}: {as_words(given)}: expected {self}: the policy has seen no others"
            )

    def __str__(self) -> str:
        if np.isinf(self.low).all() and np.isinf(self.high).all():
            return "any numbers, as it is not known which the policy has seen"
        return f"{as_words(self.low)} to {as_words(self.high)}"


def as_words(values: Array) -> str:
    """Return the numbers of a command as an operator would say them."""
    return " ".join(f"{value:g}" for value in values)


def command_ranges(meta: Export) -> dict[str, CommandRange]:
    """Return the range of each command of an export."""
    return {name: CommandRange(name, spec) for name, spec in meta["commands"].items()}
