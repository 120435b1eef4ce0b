"""A row of the table is a fault, what must happen, and the figures that show whether it did."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

Figures = Mapping[str, float]
AT_MOST, AT_LEAST, EXACTLY = "at most", "at least", "exactly"
_HOLDS: dict[str, Callable[[float, float], bool]] = {
    AT_MOST: lambda figure, limit: figure <= limit,
    AT_LEAST: lambda figure, limit: figure >= limit,
    EXACTLY: lambda figure, limit: figure == limit,
}


@dataclass(frozen=True, kw_only=True)
class Row:
    """One fault.

    Attributes:
        fault: what is provoked, in a few words.
        must: what has to happen.
        limits: figure -> how it is compared, and with what: a number, or the name of one of the `amounts`.
        measure: provokes it in an empty folder, as often as the amounts say, and returns the figures.
        amounts: of the long form, which counts; `short` replaces some of them for CI.
        device: "cpu" or "cuda".
        splits: whether `measure` takes `jobs`, the number of processes over which it spreads its cases.
        files: those whose change makes the figures old, beside the benchmark itself.
    """

    fault: str
    must: str
    limits: Mapping[str, tuple[str, float | str]]
    measure: Callable[..., Figures]
    amounts: Mapping[str, int] = field(default_factory=dict)
    short: Mapping[str, int] = field(default_factory=dict)
    device: str = "cpu"
    splits: bool = False
    files: tuple[str, ...] = ()

    def run(self, folder: Path, *, short: bool, jobs: int = 1) -> tuple[Figures, list[str]]:
        """Measure, in `jobs` processes if it splits; return the figures, and a line for each that breaks its limit."""
        amounts = {**self.amounts, **(self.short if short else {})}
        processes = {"jobs": jobs} if self.splits else {}
        figures = self.measure(folder, **amounts, **processes)
        return figures, self.broken(figures, amounts)

    def broken(
        self, figures: Mapping[str, float], amounts: Mapping[str, int] | None = None
    ) -> list[str]:
        """Return the limits that the figures break; one without a figure is broken."""
        amounts = self.amounts if amounts is None else amounts
        found = []
        for name, (how, limit) in self.limits.items():
            number = amounts[limit] if isinstance(limit, str) else limit
            if name not in figures or not _HOLDS[how](figures[name], number):
                found.append(f"{name} = {figures.get(name, 'absent')}: expected {how} {number:g}")
        return found
