"""Makes the table of docs/notes/rough_ground.md: successes and falls on each kind of ground."""

from collections.abc import Mapping
from typing import Any

from benchmarks.pages.committed import last_run
from ksim_rl.tasks.rough_ground import PATCHES

TASKS = ("go1_velocity_rough", "g1_velocity_rough")


def cells(prefix: str | None, kind: str, saved: Mapping[str, Any]) -> list[str]:
    """Successes, falls and levels of a task on a kind of ground, or in the mean over all where it is ""."""
    if prefix is None:
        return ["–"] * 3
    key = f"{prefix}/{kind}".rstrip("/")
    success, fell, levels = (
        saved["figures"][f"{key}/{name}"] for name in ("success", "fell", "levels")
    )
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
    return "\n".join(
        [*lines, "", *(about(task, prefix, saved) for task, prefix in prefixes.items())]
    )
