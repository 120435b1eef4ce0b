"""Makes docs/tasks.md from the configs of the tasks, and from what was measured and learned with them."""

import itertools
import json
import os
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks import report, tasks
from benchmarks.pages.committed import last_run, results
from ksim_rl import envs
from ksim_rl.scene.scene import SceneCfg
from ksim_rl.tables.levels import worst
from ksim_rl.tables.table import Row, load

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
TABLES = {
    name: report.RESULTS / "tables" / f"{name}.json"
    for name in ("tasks", "velocity", "humanoids", "tracking", "motions", "pixels")
}
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
MEASURED = (
    ("env_states_per_s", "{:,.0f}"),
    ("rollout_over_physics", "{:.2f}"),
    ("syncs", "{:.0f}"),
)
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
OLDER = (
    "Rows whose ratio is below 1 were measured before this package had a constraint solver of its own: they are\n"
    "slower than what you will see."
)
LEARNED = """## What was learned

By `ksim-rl reproduce tasks`, for Go1, G1, `g1_track_*` and `g1_track` `ksim-rl reproduce velocity`, `humanoids`,
`tracking` and `motions`, and for pictures `pixels`, with [one protocol](tables.md#the-protocol).

* **env states**, **seconds**: of a run's training, its first iteration included. Runs of G1 and Go1 on flat ground had
  a GPU of their own, the others shared one with up to ten; a run that is alone takes less time. On a CPU a run had one
  core.
* **return**: the mean over the final policy's episodes and over the seeds, with the standard deviation between seeds.
* **asked for**: what came out, and in brackets what should: *solved at* of the mean return; for the worst seed the
  rewards for following a velocity command (2 each at most, over the last million env states of training), the share of
  1000 robots that stand 6 s after they were dropped, or of 1024 trials in which a motion is followed to its end. Where
  the two rewards have a time, it is the median of the seeds'.

[Learning](learning.md#how-well-they-learn) compares algorithms, and says how far Go1 gets on
[each kind of rough ground](notes/rough_ground.md). Its levels rise as training goes on, so rewards say little there.
The two rough tasks have no row below: they have not been trained since a foot on a height field touches each prism
under it, as in the C engine.
"""
LEARNED_COLUMNS = (
    "task",
    "objective",
    "env states",
    "seconds",
    "return",
    "asked for",
    "reached",
    "seeds",
)


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
    if (prefix := last_run(saved, name, str(NUM_ENVS))) is None:
        return (NOTHING,) * (len(MEASURED) + 1)
    values = (
        form.format(saved["figures"][f"{prefix}/{key}"])
        if f"{prefix}/{key}" in saved["figures"]
        else NOTHING
        for key, form in MEASURED
    )
    return (*values, saved["outcomes"][prefix]["check_env"])


def tail(saved: Mapping[str, Any]) -> str:
    """Where and at which commit the figures were measured, and that some are old while they are of several."""
    prefixes = [prefix for name in own_tasks() if (prefix := last_run(saved, name, str(NUM_ENVS)))]
    devices = sorted({saved["runs"][prefix]["device"] for prefix in prefixes})
    commits = sorted({saved["runs"][prefix]["commit"] for prefix in prefixes})
    said = f"commit{'s' * (len(commits) > 1)} {' and '.join(commit[:7] for commit in commits)}"
    text = f"The last four columns are of {' and '.join(devices)}, at {said}:\n"
    command = f"`python -m benchmarks.tasks device=cuda num_envs={NUM_ENVS}`."
    return text + command + ("\n" + OLDER if len(commits) > 1 else "")


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
    """All tasks that belong to no suite: docs/tables.md has the suites."""
    return [name for name in envs.names() if not envs.task(name).suite]


def page(sizes: Mapping[str, Mapping[str, str]] | None = None) -> str:
    """Return the page, with these sizes of tasks or the present ones."""
    if sizes is None:
        sizes = present_sizes()
    saved = results("tasks")
    head = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    rows = [row(name, sizes[name], saved) for name in own_tasks()]
    tables = {name: json.loads(path.read_text()) for name, path in TABLES.items() if path.exists()}
    return (
        f"{HEAD}\n"
        + "\n".join([*head, *rows])
        + f"\n\n{tail(saved)}\n\n{LEARNED}\n{learned(tables)}\n"
    )


def learned(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Results of each task in the tables of results, with their commit."""
    rows = []
    for table in TABLES:
        for name, of_table in load(table).rows.items():
            # Tasks of suites have a page of their own.
            if not envs.task(of_table.task).suite:
                rows.append((table, name, of_table))
    lines: dict[str, list[str]] = {name: [] for name in own_tasks()}
    runs_of: dict[str, list[Any]] = {name: [] for name in lines}
    for table, name, of_table in rows:
        saved = tables.get(table, {}).get("rows", {}).get(name)
        if saved is not None:
            lines[of_table.task].append(learned_row(of_table, saved))
            runs_of[of_table.task] += saved["runs"]
    for _, _, of_table in rows:
        # Until one of its rows has a result.
        lines[of_table.task] = lines[of_table.task] or [learned_row(of_table, None)]
    head = ["| " + " | ".join(LEARNED_COLUMNS) + " |", "|" + "---|" * len(LEARNED_COLUMNS)]
    return "\n".join([*where(runs_of), *head, *itertools.chain(*lines.values())])


def learned_row(of_table: Row, saved: Mapping[str, Any] | None) -> str:
    """The cells of a task, whose result may not be there yet."""
    cells = [f"`{of_table.task}`", of_table.objective]
    if saved is None:
        cells += ["not measured", *(NOTHING,) * 5]
        return f"| {' | '.join(cells)} |"
    runs = saved["runs"]
    returns = [run["evaluation"]["return_mean"] for run in runs]
    spread = f" ± {statistics.stdev(returns):.1f}" if len(runs) > 1 else ""
    states, seconds = (
        statistics.fmean(run[key] for run in runs) for key in ("env_states", "seconds")
    )
    took = f"{seconds:.0f}" + (" on a CPU" if {run["device"] for run in runs} == {"CPU"} else "")
    asked = []
    if of_table.measure == "success":
        asked.append(f"followed {saved['value']:.3f} ({saved['goal']:g})")
    elif of_table.measure == "seconds":
        rewards = " and ".join(f"{level:.2f}" for level in of_table.levels.values())
        within = "" if saved["goal"] is None else f" ({saved['goal']:g})"
        asked.append(f"rewards of {rewards} after {saved['value']:.1f} s{within}")
    elif saved["goal"] is not None:
        asked.append(f"return {saved['value']:.4g} ({saved['goal']:g})")
    for name, level in of_table.levels.items() if of_table.measure == "return" else ():
        values = [run["means"].get(name) for run in runs]
        reached = "not logged" if None in values else f"{worst(name, values):.2f}"
        asked.append(f"{name.rpartition('/')[2]} {reached} ({level:g})")
    cells += [f"{states / 1e6:.1f} million", took, f"{statistics.fmean(returns):.1f}{spread}"]
    verdict = {True: "yes", False: "no", None: NOTHING}[saved["reached"]]
    return f"| {' | '.join([*cells, ', '.join(asked) or NOTHING, verdict, str(len(runs))])} |"


def where(runs_of: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
    """A sentence on GPUs and commits of the runs, where there are some; most share one, and others are named."""
    by_commit: dict[str, list[str]] = {}
    for task, runs in sorted(runs_of.items()):
        for commit in dict.fromkeys(run["commit"] for run in runs):
            by_commit.setdefault(commit, []).append(task)
    if not by_commit:
        return []
    most, *others = sorted(by_commit, key=lambda commit: -len(by_commit[commit]))
    devices = sorted({run["device"] for runs in runs_of.values() for run in runs})
    names = (
        f"{', '.join(f'`{task}`' for task in by_commit[commit])} at {commit[:7]}"
        for commit in others
    )
    but = f", but {'; '.join(names)}" if others else ""
    return [f"Runs are of {' and '.join(devices)}, at commit {most[:7]}{but}.", ""]


def size_of(name: str) -> dict[str, str]:
    """Return the sizes of a task, from its env."""
    env = envs.make(name, num_envs=1)
    sizes = tasks.sizes(env)
    env.close()
    return {key.removesuffix("_size"): str(int(value)) for key, value in sizes.items()}


def built_sizes() -> dict[str, dict[str, str]]:
    """Return the sizes of all tasks, from their envs."""
    return {name: size_of(name) for name in own_tasks()}


def present_sizes() -> dict[str, dict[str, str]]:
    """Return the sizes that the page gives; a task without a row is built for its sizes."""
    written = written_sizes()
    found = {}
    for name in own_tasks():
        # To build all envs takes minutes, and needs all models: a test that runs at night compares the rows.
        if name in written:
            found[name] = written[name]
        else:
            found[name] = size_of(name)
    return found


def written_sizes() -> dict[str, dict[str, str]]:
    """The sizes that the page gives."""
    found = {}
    for line in PAGE.read_text().split("## What was learned")[0].splitlines():
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.strip("|").split(" | ")]
            found[cells[0].strip("`")] = {column: cells[COLUMNS.index(column)] for column in SIZES}
    return found
