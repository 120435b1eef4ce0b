"""The table of tasks says what the tasks' configs and their measurements say.

To write it anew: python -m tests.docs.test_tasks. It builds every task once, for the sizes, and needs all robots.
"""

import json
import os
import statistics
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from benchmarks import report, tasks
from ksim_rl import envs
from ksim_rl.scene.scene import SceneCfg

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
RESULTS = report.RESULTS / "tasks.json"
NUM_ENVS = 4096
COLUMNS = (
    "task",
    "what",
    "robot",
    "actions",
    "action",
    "actor",
    "critic",
    "episode",
    "solved at",
    "env states/s",
    "of physics",
    "syncs",
    "`check_env`",
)
SIZES = ("action", "actor", "critic")
MEASURED = (("env_states_per_s", "{:,.0f}"), ("rollout_over_physics", "{:.2f}"), ("syncs", "{:.0f}"))
NOTHING = "–"
HEAD = f"""# Tasks

All tasks that come with the package: `ksim-rl train task=<task>`, or `envs.make("<task>", num_envs=...)`.

* **robot**: what is in the scene. Those marked (m) need a model of the MuJoCo Menagerie, which the package
  `mujoco-menagerie` downloads on first use, or which is under `MENAGERIE_ROOT`; all others come with this package.
* **actions**, **action**: the action terms, and the length of `"action"`.
* **actor**, **critic**: the lengths of the observations of these groups.
* **episode**: its length in simulated time, if nothing ends it earlier.
* **solved at**: the mean evaluation return at which training may stop, where the task has one.
* **env states/s**: of captured rollouts of {NUM_ENVS} envs on one GPU, with the actor that training gives the task, its
  first random actions, and resets. **of physics**: that, relative to MuJoCo Warp's physics alone: the substeps of an
  env step as one graph, from states of the same run.
* **syncs**: times that the host waits for the device in a step with its reset. **`check_env`**: the result of
  `ksim_rl.testing.check_env`.
"""
TAIL = f"""The last four columns are measured on an H200: `python -m benchmarks.tasks device=cuda num_envs={NUM_ENVS}`.
Rows whose ratio is below 1 were measured before this package had a constraint solver of its own: they are slower than
what you will see."""


LEARNED = """## What was learned

By training runs on one H200 that are committed in `benchmarks/results/learning_*.json`: the env states of a run, its
seconds with the first iteration, the mean return of the training episodes at its end (medians over the seeds), and the
commit that it was made of. Each row is of its own commit, and most tasks have no committed run of this kind yet.

| task | objective | env states | seconds | return | seeds | commit |
|---|---|---|---|---|---|---|
"""


def robots(scene: SceneCfg) -> str:
    """The classes of what is in a scene; those that cannot be made without the menagerie are marked."""
    return ", ".join(
        f"`{type(entity).__name__}`" + (" (m)" if needs_menagerie(entity) else "")
        for entity in scene.entities.values()
    )


def needs_menagerie(robot: Any) -> bool:
    with tempfile.TemporaryDirectory() as empty, mock.patch.dict(os.environ, MENAGERIE_ROOT=empty):
        try:
            robot.spec()
        except ValueError as error:
            assert "menagerie" in str(error)
            return True
    return False


def episode(cfg: envs.ManagerBasedRlEnvCfg) -> str:
    if not cfg.episode_length_s:
        return "no limit"
    return f"{cfg.episode_length_s:g} s"


def measured(name: str, saved: Mapping[str, Any]) -> tuple[str, ...]:
    """The GPU's figures of a task, of the last run if there are several."""
    runs = {
        prefix: run
        for prefix, run in saved.get("runs", {}).items()
        if prefix.split("/")[1:] == [name, str(NUM_ENVS)] and not prefix.startswith("cpu/")
    }
    if not runs:
        return (NOTHING,) * (len(MEASURED) + 1)
    prefix = max(runs, key=lambda prefix: runs[prefix]["date"])
    values = (
        form.format(saved["figures"][f"{prefix}/{key}"]) if f"{prefix}/{key}" in saved["figures"] else NOTHING
        for key, form in MEASURED
    )
    return (*values, saved["outcomes"][prefix]["check_env"])


def row(name: str, size: Mapping[str, str], saved: Mapping[str, Any]) -> str:
    task = envs.task(name)
    cfg = task.cfg()
    actions = ", ".join(f"`{type(term).__name__}`" for term in cfg.actions.values())
    cells = (
        f"`{name}`",
        task.description,
        robots(cfg.scene),
        actions,
        *(size[column] for column in SIZES),
        episode(cfg),
        NOTHING if task.solved_at is None else f"{task.solved_at:g}",
        *measured(name, saved),
    )
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def own_tasks() -> list[str]:
    """All tasks but those of suites, which docs/tables.md has."""
    return [name for name in envs.names() if not envs.task(name).suite]


def page(sizes: Mapping[str, Mapping[str, str]], saved: Mapping[str, Any]) -> str:
    head = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    rows = [row(name, sizes[name], saved) for name in own_tasks()]
    after = "\n".join(line for name in own_tasks() for line in learned(name))
    return f"{HEAD}\n" + "\n".join([*head, *rows]) + f"\n\n{TAIL}\n\n{LEARNED}{after}\n"


def learned(name: str) -> list[str]:
    """The rows of a task: for each kind of GPU run the medians over its seeds of the last points of the curves."""
    rows = []
    for path in sorted(report.RESULTS.glob(f"learning_{name}*.json")):
        saved = json.loads(path.read_text())
        objective = path.stem.removeprefix(f"learning_{name}").lstrip("_") or "ppo"
        curves = saved.get("curves", {}).items()
        if ends := [points[-1] for label, points in curves if label.startswith(f"h200/{name}/")]:
            states, seconds, reward = (
                statistics.median(end[key] for end in ends)
                for key in ("env_states", "seconds", "episode/return")
            )
            cells = f"{states / 1e6:.1f} million", f"{seconds:.0f}", f"{reward:.1f}", f"{len(ends)}"
            rows.append(" | ".join((f"| `{name}`", objective, *cells, f"{saved['commit']} |")))
    return rows or [f"| `{name}` | {NOTHING} | not measured" + f" | {NOTHING}" * 4 + " |"]


def built_sizes() -> dict[str, dict[str, str]]:
    """The sizes of all tasks, from their envs."""
    found = {}
    for name in own_tasks():
        env = envs.make(name, num_envs=1)
        found[name] = {key.removesuffix("_size"): str(int(value)) for key, value in tasks.sizes(env).items()}
        env.close()
    return found


def written_sizes() -> dict[str, dict[str, str]]:
    """The sizes that the page gives."""
    found = {}
    for line in PAGE.read_text().split("## What was learned")[0].splitlines():
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.strip("|").split(" | ")]
            found[cells[0].strip("`")] = {column: cells[COLUMNS.index(column)] for column in SIZES}
    return found


def results() -> dict[str, Any]:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


OUT_OF_DATE = "docs/tasks.md is out of date: python -m tests.docs.test_tasks"


def test_the_table_of_tasks_lists_all_tasks_as_they_are():
    sizes = written_sizes()
    assert list(sizes) == own_tasks(), OUT_OF_DATE
    assert all(size.isdecimal() for task in sizes.values() for size in task.values())
    assert PAGE.read_text().splitlines() == page(sizes, results()).splitlines(), OUT_OF_DATE


def test_the_figures_are_those_of_the_last_run_on_a_gpu():
    dates = {
        "cpu/reacher/4096": "3",
        "h200/reacher/4096": "2",
        "h100/reacher/4096": "1",
        "h200/reacher/8": "4",
    }
    saved = {
        "runs": {prefix: {"date": date} for prefix, date in dates.items()},
        "outcomes": {prefix: {"check_env": f"passed {prefix}"} for prefix in dates},
        "figures": {
            "h200/reacher/4096/env_states_per_s": 1234567.8,
            "h200/reacher/4096/syncs": 0.0,
            "h100/reacher/4096/rollout_over_physics": 0.5,
        },
    }
    assert measured("reacher", saved) == ("1,234,568", NOTHING, "0", "passed h200/reacher/4096")
    assert measured("walker_run", saved) == (NOTHING,) * 4


@pytest.mark.full
def test_the_sizes_are_those_of_the_envs():
    try:
        sizes = built_sizes()
    except ValueError as error:
        if "menagerie" not in str(error):
            raise
        pytest.skip(str(error))
    assert written_sizes() == sizes, OUT_OF_DATE


if __name__ == "__main__":
    PAGE.write_text(page(built_sizes(), results()))
