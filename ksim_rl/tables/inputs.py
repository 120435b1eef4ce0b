"""What a row reads beside its settings: run folders of the rows that it learns from."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ksim_rl.tables.lineage import run_of, sources_of
from ksim_rl.tables.table import Row


@dataclass(frozen=True, kw_only=True)
class Sources:
    """What a row may find of the rows that it learns from.

    Attributes:
        runs: the folder of all runs of the table.
        settings: the fingerprints of these rows, by name.
    """

    runs: Path
    settings: Mapping[str, str]

    def folders(self, row: Row, seed: int) -> dict[str, Path]:
        """Return the run folders of the rows that a row learns from, by name.

        A ValueError names one that is not there.
        """
        found = {}
        for name in sources_of(row):
            folder = run_of(self.runs, name, seed)
            if not folder.is_dir():
                raise ValueError(
                    f"{folder}: no run of row {name!r} with seed {seed}, which this row learns from: let ksim-rl "
                    "reproduce run that row first"
                )
            found[name] = folder
        return found
