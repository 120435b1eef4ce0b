"""Keeps all metrics of a run in one CSV file, one row per logged iteration."""

import csv
import io
import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from ksim_rl.files.reading import MOST_TEXT_BYTES, open_regular
from ksim_rl.files.writing import check_own, whole_file

STEP = "env_states"
# Of a table in memory: more columns are refused, and of more cells only each second, fourth ... row is kept.
MOST_COLUMNS = 10_000
MOST_CELLS = 4_000_000
MOST_LETTERS = 2**22  # of a line
T = TypeVar("T")


class CsvTable:
    """A CSV file that grows by rows, and by columns when a metric appears for the first time.

    TorchRL's `CSVLogger` writes one file per metric; this one opens in a spreadsheet. A cell is empty where a row has
    no such metric. Rows at or beyond the first step that is logged are dropped, so that a resumed run has each
    iteration once. However long the table is, only its last row is in memory.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        check_own(path)  # rows are appended in place
        with _opened(path) as (self._columns, _):
            pass
        # The last row, and those before it that could not be written yet.
        self._rows: list[dict[str, str]] = []
        # Its place in the file; None: the whole table has to be copied.
        self._last_begins: int | None = None

    def log_metrics(self, metrics: Mapping[str, float], step: int) -> None:
        """Append one row, or complete the last one."""
        # Nine digits are enough for float32.
        row = {STEP: str(step), **{name: f"{value:.9g}" for name, value in metrics.items()}}
        # A metric that appears for the first time is a new column for all rows.
        new_columns = [name for name in row if name not in self._columns]
        # Evaluations complete the row of their iteration.
        same_row = bool(self._rows) and int(self._rows[-1][STEP]) == step
        if same_row:
            row = self._rows.pop() | row
        self._rows.append(row)
        self._columns += new_columns
        # None until the row is written, so that after a failure the next row copies the table.
        begins = self._last_begins
        self._last_begins = None
        if new_columns or begins is None:
            begins = self._copy()
        else:
            # In place: the last row is written again, or a row is added.
            with open(self.path, "r+", newline="") as file:
                if same_row:
                    begins = file.seek(begins)
                else:
                    begins = file.seek(0, io.SEEK_END)
                self._writer(file).writerow(row)
                # The rest of a longer row must not stay behind.
                file.truncate()
        self._last_begins = begins
        # All rows are on the disk; the last one may still be completed.
        del self._rows[:-1]

    def close(self) -> None:
        """Do nothing: each row is written when it is logged."""

    def _copy(self) -> int:
        """Write the table again with all columns, row by row; return where its last row begins."""
        with whole_file(self.path) as temporary, open(temporary, "w", newline="") as file:
            writer = self._writer(file)
            writer.writeheader()
            with _opened(self.path) as (_, rows):
                # Rows at or beyond this step come from a run that is resumed before them.
                begin = int(self._rows[0][STEP])
                writer.writerows(row for row in rows if int(row[STEP]) < begin)
            writer.writerows(self._rows[:-1])
            begins = file.tell()
            writer.writerow(self._rows[-1])
        return begins

    def _writer(self, file) -> csv.DictWriter:
        return csv.DictWriter(file, self._columns, restval="", lineterminator="\n")


def read_table(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Read a table: its columns, and its rows as text by column, without those cells that are empty.

    A row that a crash cut off is left out. Of a table with more than `MOST_CELLS` cells the rows are thinned, but for
    the last one. A ValueError refuses other files.
    """
    open_regular(path, limit=MOST_TEXT_BYTES).close()  # which says that there is none
    kept: list[dict[str, str]] = []
    last: dict[str, str] = {}
    every = 1
    cells = 0
    try:
        with _opened(path) as (columns, rows):
            # A number of rows is not known beforehand, so thinning goes on while reading.
            for number, row in enumerate(rows):
                last = {name: text for name, text in row.items() if text}
                if number % every:
                    continue
                kept.append(last)
                cells += len(last)
                # Half of the rows, as often as needed.
                while cells > MOST_CELLS and len(kept) > 1:
                    kept = kept[::2]
                    every = 2 * every
                    cells = sum(map(len, kept))
    except csv.Error as error:
        raise ValueError(f"{path}: damaged: {error}") from error
    if kept and kept[-1] is not last:
        kept.append(last)
    return columns, kept


@contextmanager
def _opened(path: Path) -> Iterator[tuple[list[str], Iterator[dict[str, str]]]]:
    """Give the columns of a table, and its whole rows one by one; without a file, the columns of a new table."""
    if path.exists():
        content = open_regular(path, limit=MOST_TEXT_BYTES)
    else:
        content = io.BytesIO()
    with io.TextIOWrapper(content, errors="replace", newline="") as file:
        # By limited lines: a file without line ends would fill the memory.
        lines = iter(lambda: file.readline(MOST_LETTERS), "")
        head = next(lines, "")
        if head.count(",") >= MOST_COLUMNS:
            raise ValueError(f"{path}: damaged: more than {MOST_COLUMNS} columns")
        # A last line without its end was cut off by a crash.
        reader = csv.DictReader(
            line for line in itertools.chain([head], lines) if line.endswith("\n")
        )
        # Rows with too few or too many cells are damaged.
        rows = (row for row in reader if row.get(STEP) and None not in row.values())
        yield list(reader.fieldnames or [STEP]), rows


def thinned(rows: Sequence[T], count: int) -> list[T]:
    """Return about so many of the rows, the last one among them."""
    return [*rows[: -1 : max(1, len(rows) // count)], rows[-1]]
