"""This row resumes runs whose manifests have a right hash and hold another state."""

from __future__ import annotations

from pathlib import Path

from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row


def crafted_manifests(folder: Path, *, manifests: int) -> Figures:
    """Craft manifests of a run, and resume each."""
    from tests.trainers.crafted_manifests import figures

    return figures(folder, manifests=manifests)


ROWS = {
    "crafted_manifests": Row(
        fault="manifests with a right hash in which parts of the state are gone, or of another kind",
        must="refused in one line, exit code 2, or resumed where the part is not needed",
        limits={"manifests": (AT_LEAST, "manifests"), "not_refused_in_one_line": (EXACTLY, 0)},
        measure=crafted_manifests,
        amounts={"manifests": 20},
        short={"manifests": 4},
        files=("ksim_rl/trainers", "tests/trainers/crafted_manifests.py"),
    ),
}
