"""The table of the course of rough ground says what the results say.

To write it anew: python -m tests.docs.test_terrain_course.
"""

from collections.abc import Mapping
from typing import Any

from benchmarks import report
from ksim_rl.tasks.velocity import PATCHES
from tests.docs.committed import last_run, results
from tests.docs.guide import DOCS

PAGE = DOCS / "notes" / "rough_ground.md"
TASKS = ("go1_velocity_rough", "g1_velocity_rough")
BEGIN, END = "<!-- table: python -m tests.docs.test_terrain_course -->", "<!-- end of the table -->"


def cells(prefix: str | None, kind: str, saved: Mapping[str, Any]) -> list[str]:
    """Successes, falls and levels of a task on a kind of ground, or in the mean over all where it is ""."""
    if prefix is None:
        return ["–"] * 3
    key = f"{prefix}/{kind}".rstrip("/")
    success, fell, levels = (saved["figures"][f"{key}/{name}"] for name in ("success", "fell", "levels"))
    return [f"{success:.1%}", f"{fell:.1%}", f"{levels:.0f}" if kind else f"{levels:.1f}"]


def about(task: str, prefix: str | None, saved: Mapping[str, Any]) -> str:
    """A sentence on how the policy was trained, and where it walked."""
    if prefix is None:
        return f"`{task}` was not measured yet."
    figures, run = saved["figures"], saved["runs"][prefix]
    states = figures.get(f"{prefix}/env_states")
    level = figures.get(f"{prefix}/trained_level")
    trained = "" if states is None else f" after {states / 1e6:.0f} million env states"
    reached = "" if level is None else f", with a mean level of {level:.1f} (of 0 to 9) in training"
    where = f"on {run['device']} at commit {run['commit'].partition('-')[0][:7]}"
    lost = " Contacts did not fit." if saved.get("lost", {}).get(prefix) else ""
    return f"`{task}`: a policy{trained}{reached}, {where}.{lost}"


def table(saved: Mapping[str, Any]) -> str:
    prefixes = {task: last_run(saved, task) for task in TASKS}
    head = ["ground", *(name for task in TASKS for name in (f"`{task}`", "fell", "levels"))]
    rows = [
        [title, *(cell for prefix in prefixes.values() for cell in cells(prefix, kind, saved))]
        for title, kind in (*((kind, kind) for kind in PATCHES), ("mean", ""))
    ]
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    lines.insert(1, "|" + "---|" * len(head))
    return "\n".join([*lines, "", *(about(task, prefix, saved) for task, prefix in prefixes.items())])


def page() -> str:
    """The page with its table made anew."""
    return report.filled(PAGE.read_text(), BEGIN, END, table(results("terrain_course")))


def test_the_table_is_that_of_the_results():
    assert PAGE.read_text() == page(), "write it anew: python -m tests.docs.test_terrain_course"


def test_a_row_shows_the_last_run_on_a_gpu_and_no_other():
    figures = {"success": 0.5, "fell": 0.25, "levels": 3}

    def run(label: str, date: str, success: float) -> tuple[dict[str, Any], dict[str, Any]]:
        prefix = f"{label}/go1_velocity_rough"
        own = {f"{prefix}/{kind}/{name}": value for kind in PATCHES for name, value in figures.items()}
        own |= {f"{prefix}/{name}": value for name, value in (figures | {"success": success}).items()}
        own |= {f"{prefix}/env_states": 250_085_376, f"{prefix}/trained_level": 5.61}
        made = {"date": date, "device": label.upper(), "commit": "0123456789-dirty"}
        return own, {prefix: made, f"{prefix}/flat": made}

    runs = [run("h200", "2026-01-01", 0.1), run("h100", "2026-01-02", 0.875), run("cpu", "2026-01-03", 0.3)]
    saved = {"figures": {}, "runs": {}}
    for own, made in runs:
        saved["figures"] |= own
        saved["runs"] |= made
    shown = table(saved)
    assert "| mean | 87.5% | 25.0% | 3.0 | – | – | – |" in shown.splitlines()
    assert "| stairs_up | 50.0% | 25.0% | 3 | – | – | – |" in shown.splitlines()
    assert (
        "`go1_velocity_rough`: a policy after 250 million env states, with a mean level of 5.6 (of 0 to 9) in "
        "training, on H100 at commit 0123456." in shown.splitlines()
    )
    assert "`g1_velocity_rough` was not measured yet." in shown.splitlines()


if __name__ == "__main__":
    PAGE.write_text(page())
