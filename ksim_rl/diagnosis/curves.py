"""The metrics of a run are read from its folder here, finished or not, and asked how they were early and late."""

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ksim_rl.config import plain_data
from ksim_rl.config.trees import Tree
from ksim_rl.runs.csv_table import read_table
from ksim_rl.runs.listing import CONFIG, METRICS

# Fewer rows say nothing about where a run is going.
LEAST_ROWS = 10
# "Early" is this share of a metric's values at the beginning, "late" the same at the end.
SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class Curves:
    """The logged metrics of a run, each a column with None where a row has no such metric, and its config as a tree."""

    columns: Mapping[str, Sequence[float | None]]
    config: Tree = field(default_factory=dict)

    @property
    def num_rows(self) -> int:
        """Rows of the table."""
        return max((len(column) for column in self.columns.values()), default=0)

    def values(self, name: str) -> list[float]:
        """Return a metric's values, oldest first, where they were finite numbers."""
        return [
            value
            for value in self.columns.get(name, ())
            if value is not None and math.isfinite(value)
        ]

    def early(self, name: str) -> float | None:
        """Return the median of the first fifth of a metric's values, or None where there are too few of them."""
        values = self.values(name)
        return _median(values[: _span(values)])

    def late(self, name: str) -> float | None:
        """Return the median of the last fifth of a metric's values, or None where there are too few of them."""
        values = self.values(name)
        return _median(values[-_span(values) :])

    def last(self, name: str) -> float | None:
        """Return a metric's last value, which is all there may be of one that evaluations log."""
        return next(reversed(self.values(name)), None)

    def names(self, room: str) -> list[str]:
        """Return the metrics `<room>/<name>`."""
        return [name for name in self.columns if name.startswith(f"{room}/")]

    def setting(self, path: str, default: float) -> float:
        """Return a number of the config by dotted path, or the default where there is none."""
        value: Any = self.config
        # A setting of another algorithm is missing: its default stands for it.
        for name in path.split("."):
            if isinstance(value, Mapping):
                value = value.get(name)
            else:
                value = None
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if is_number:
            return float(value)
        return default


def _span(values: Sequence[float]) -> int:
    # At least three, so that the median ignores one that is off. Of the values and not of the rows: what few rows have,
    # such as figures of evaluations, would be early and late at once.
    return max(3, round(SHARE * len(values)))


def _median(values: Sequence[float]) -> float | None:
    if len(values) >= 3:
        return statistics.median(values)
    return None


def read_run(folder: Path) -> Curves:
    """Read the metrics of a run folder, or of the run that a checkpoint belongs to; a run may be under way.

    Raises ValueError where there is no table of metrics, or it is damaged.
    """
    # The folder itself, or the run folder of a checkpoint two levels below it.
    places = [folder, *folder.absolute().parents[:2]]
    found = next((place for place in places if (place / METRICS).is_file()), None)
    if found is None:
        raise ValueError(
            f"{folder}: there is no {METRICS}: name the folder of a run whose logger wrote one (logger.csv=true)"
        )
    # A table without its config is still worth a diagnosis.
    if (found / CONFIG).is_file():
        config = plain_data.read_yaml(found / CONFIG)
    else:
        config = {}
    return Curves(
        columns=_columns(found / METRICS), config=config if isinstance(config, Mapping) else {}
    )


def _number(text: str | None) -> float | None:
    """Return the number in a cell of a table, and None for a cell that is empty."""
    if text:
        return float(text)
    return None


def _columns(path: Path) -> dict[str, list[float | None]]:
    names, rows = read_table(path)
    try:
        columns = {}
        for name in names:
            columns[name] = [_number(row.get(name)) for row in rows]
        return columns
    except ValueError as error:
        raise ValueError(f"{path}: damaged: {error}") from error
