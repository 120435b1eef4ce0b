"""These rows run `sim2sim` on exported folders of strangers, and `reproduce` on their tables."""

from __future__ import annotations

from pathlib import Path

from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row


def sim2sim_folders(folder: Path, *, folders: int) -> Figures:
    """Export a policy, change the folder as strangers may, and run `ksim-rl sim2sim` on each."""
    from tests.export.strange_folders import figures
    from tests.export.test_sim2sim import exported

    whole = exported("cartpole_balance", folder / "export")
    return figures(whole, folder, folders=folders)


def strange_tables(folder: Path, *, tables: int) -> Figures:
    """Run `ksim-rl reproduce` on tables whose names and overrides lead out."""
    from tests.tables.strange_tables import figures

    return figures(folder, tables=tables)


ROWS = {
    "sim2sim_folders": Row(
        fault="exported folders that write index arrays, other shapes and NaN, are cut, or claim terabytes",
        must="refused in one line, exit code 2; nothing hangs; the folder as it was exported runs",
        limits={
            "folders": (AT_LEAST, "folders"),
            "whole_one_runs": (EXACTLY, 1),
            **dict.fromkeys(("hangs", "not_refused_in_one_line"), (EXACTLY, 0)),
        },
        measure=sim2sim_folders,
        amounts={"folders": 38},
        short={"folders": 10},
        files=("ksim_rl/export", "tests/export/strange_folders.py"),
    ),
    "strange_tables": Row(
        fault="tables whose names, groups and rows are paths, whose overrides write elsewhere or read the environment",
        must="refused in one line, exit code 2; nothing written, deleted or told",
        limits={
            "tables": (AT_LEAST, "tables"),
            **dict.fromkeys(("not_refused_in_one_line", "written_deleted_or_leaked"), (EXACTLY, 0)),
        },
        measure=strange_tables,
        amounts={"tables": 28},
        short={"tables": 4},
        files=("ksim_rl/tables", "ksim_rl/config", "tests/tables/strange_tables.py"),
    ),
}
