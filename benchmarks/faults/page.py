"""The table of docs/reliability.md is made from benchmarks/results/faults.json."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks import report
from benchmarks.faults.growth import PICTURE
from benchmarks.faults.rows import ROWS

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
COMMITTED = Path(__file__).parents[1] / "results"
BEGIN, END = "<!-- table: python -m benchmarks.faults -->", "<!-- end of the table -->"
NOT_MEASURED = "not measured: no CUDA device"


def write_row(
    name: str, figures: Mapping[str, float], *, passed: bool, folder: Path | None = None
) -> None:
    """Add what was measured of one row to the results, and renew the page's table where they are committed."""
    row = ROWS[name]
    device = torch.device(row.device)
    label = report.device_label(device)
    path = report.write(
        "faults",
        figures={f"{label}/{name}/{figure}": float(value) for figure, value in figures.items()},
        device=device,
        module="benchmarks.faults",
        folder=folder or report.RESULTS,
        passed={name: passed},
        limits={
            f"{label}/{name}/{figure}": f"{how} {row.amounts[limit] if isinstance(limit, str) else limit:g}"
            for figure, (how, limit) in row.limits.items()
        },
    )
    _show(path)


def merge(sources: Sequence[Path]) -> None:
    """Merge the results of other folders into the results, with the soak's picture where there is one."""
    path = report.merge("faults", sources, folder=report.RESULTS)
    for source in sources:
        if (source / PICTURE).exists():
            shutil.copy(source / PICTURE, report.RESULTS / PICTURE)
    _show(path)


def _show(path: Path) -> None:
    """Say of the rows without figures why, and make the table of the page if it shows these results."""
    saved = json.loads(path.read_text())
    saved["not_measured"] = {
        other: NOT_MEASURED
        for other, row in ROWS.items()
        if row.device == "cuda" and other not in saved["passed"]
    }
    report.replace(path, saved)
    if path.parent == COMMITTED:
        PAGE.write_text(with_table(PAGE.read_text(), saved))


def passed(saved: Mapping[str, Any]) -> dict[str, bool]:
    """Compute from the figures which of the measured rows pass."""
    found = {}
    for name in saved["passed"]:
        figures = {
            figure.rpartition("/")[2]: value
            for figure, value in saved["figures"].items()
            if figure.split("/")[1] == name
        }
        found[name] = not ROWS[name].broken(figures)
    return found


def table(saved: Mapping[str, Any]) -> str:
    """Return the table: a row for each fault, with its figures or why there are none."""
    lines = ["| row | fault | must | measured | |", "|---|---|---|---|---|"]
    for name, row in ROWS.items():
        figures = {
            key: value for key, value in saved["figures"].items() if key.split("/")[1] == name
        }
        shown = ", ".join(
            f"{key.rpartition('/')[2].replace('_', ' ')} {value:g}"
            for key, value in figures.items()
        )
        missing = NOT_MEASURED if row.device == "cuda" else "not measured yet"
        verdict = {True: "passes", False: "**fails**", None: "-"}[saved["passed"].get(name)]
        lines.append(f"| `{name}` | {row.fault} | {row.must} | {shown or missing} | {verdict} |")
    return "\n".join(lines)


def with_table(text: str, saved: Mapping[str, Any]) -> str:
    """Return the page with its table renewed."""
    return report.filled(text, BEGIN, END, table(saved))
