"""This module keeps all metrics of a run in one CSV file, one row per logged iteration."""

import csv
from collections.abc import Mapping
from pathlib import Path

from ksim_rl.config.plain_data import MOST_DATA_BYTES, read_bytes
from ksim_rl.runs.whole_file import whole_file

STEP = "env_states"


class CsvTable:
    """A CSV file that grows by rows, and by columns when a metric appears for the first time.

    TorchRL's `CSVLogger` writes one file per metric; this one opens in a spreadsheet. A cell is empty where a row has
    no such metric. Rows at or beyond the first step that is logged are dropped, so that a resumed run has each
    iteration once.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._columns = read_table(path)[0] if path.exists() else [STEP]
        # The last row, and those before it that are not in the file yet; it alone holds all others.
        self._rows: list[dict[str, str]] = []
        self._started = False

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Append one row, or complete the last one."""
        row = {STEP: str(step), **{name: f"{value:.9g}" for name, value in metrics.items()}}
        new_columns = [name for name in row if name not in self._columns]
        # False until the row is written, so that after a failure the next row writes the whole table again.
        started, self._started = self._started, False
        same_row = bool(self._rows) and int(self._rows[-1][STEP]) == step
        if same_row:
            self._rows[-1] |= row
        else:
            self._rows.append(row)
        self._columns += new_columns
        if new_columns or same_row or not started:
            self._rewrite()
        else:
            with open(self.path, "a", newline="") as file:
                self._writer(file).writerow(row)
        self._started = True
        del self._rows[:-1]

    def close(self) -> None:
        """Do nothing: each row is written when it is logged."""

    def _rewrite(self) -> None:
        saved = read_table(self.path)[1] if self.path.exists() else []
        earlier = [row for row in saved if int(row[STEP]) < int(self._rows[0][STEP])]
        with whole_file(self.path) as temporary, open(temporary, "w", newline="") as file:
            writer = self._writer(file)
            writer.writeheader()
            writer.writerows([*earlier, *self._rows])

    def _writer(self, file) -> csv.DictWriter:
        return csv.DictWriter(file, self._columns, restval="", lineterminator="\n")


def read_table(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Read a table: its columns, and its rows as text by column; a row that a crash cut off is left out."""
    text = read_bytes(path, limit=MOST_DATA_BYTES).decode(errors="replace")
    reader = csv.DictReader(line for line in text.splitlines(keepends=True) if line.endswith("\n"))
    rows = [row for row in reader if row.get(STEP) and None not in row.values()]
    return list(reader.fieldnames or [STEP]), rows
