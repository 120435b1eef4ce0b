"""Lets a policy of a rough velocity task walk over a fixed course.

    python -m benchmarks.terrain_course run=RUN device=cuda num_envs=1000

takes a run folder or a checkpoint; with teacher=RUN the policy that it learned from walks the same course. What the
course is, and what counts as a success and as a fall, is told in ksim_rl/tasks/terrain_course.py. With device=cpu
MuJoCo's C engine simulates it.

Figures go to benchmarks/results/terrain_course.json, under <device>/<task>/<kind> and, in the mean over kinds, under
<device>/<task>: `success` and `fell`, means over levels; `levels`, how many of the levels, from the easiest on, at
least half of the robots succeed on. `success_by_level` has the shares of successes, from the easiest level on.
`trained_level` is the mean level that the curriculum came to in training, over the last million env states before the
policy was saved. Levels count from 0, and who has mastered the last goes on at a random one, so that it stays below it.
With a teacher, `share_of_teacher` is the success in the mean over kinds divided by the teacher's, and `weakest` the
least success of a kind at the hardest level. `lost` has a line for each kind of contacts or constraints that the
physics had no room for, and `lost_worlds` in how many worlds that was so, the teacher's included: figures of these are
not of the physics that was asked for.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from ksim_rl.runs.csv_table import read_table
from ksim_rl.runs.listing import METRICS
from ksim_rl.tables.levels import HELD_STATES
from ksim_rl.tasks.terrain_course import course_of, summary, walk
from ksim_rl.trainers.run_folder import Policy, load_policy
from ksim_rl.zoo import locate

OPTIONS = {"run": "", "teacher": "", "device": "auto", "num_envs": "1000"}
LEVEL = "curriculum/terrain_level"
"""The column of a run's metrics, as `on_rough_ground` names the term."""


def main() -> None:
    """Walk, print the table, and write the figures."""
    options = command_line.options(sys.argv[1:], OPTIONS)
    num_envs = command_line.whole_number("num_envs", options["num_envs"])
    if not options["run"]:
        raise ValueError(
            "run is missing: write run=RUN, a run folder or a checkpoint of a rough velocity task"
        )
    path = locate(options["run"])
    policy = load_policy(path, device=options["device"])
    course = course_of(policy.cfg.task)
    outcomes = walk(policy, course, num_envs=num_envs)
    success_by_level, figures = summary(
        outcomes, kinds=course.grid.columns, num_levels=course.grid.num_levels
    )
    if options["teacher"]:
        figures |= beside_teacher(
            load_policy(locate(options["teacher"]), device=options["device"]),
            success_by_level,
            success=figures["success"],
            num_envs=num_envs,
        )
    figures["lost_worlds"] = figures.get("lost_worlds", 0) + outcomes.lost_worlds
    figures |= {"num_envs": num_envs, **trained(path, policy.iteration)}
    device = policy.cfg.resolved_device()
    prefix = f"{report.device_label(device)}/{policy.cfg.task_name}"
    Console().print(_table(prefix, figures, success_by_level))
    for line in outcomes.lost:
        print(f"the physics dropped work: {line}")
    written = report.write(
        "terrain_course",
        figures={f"{prefix}/{name}": round(value, 4) for name, value in figures.items()},
        device=device,
        module="benchmarks.terrain_course",
        lost={prefix: list(outcomes.lost)},
        success_by_level={
            f"{prefix}/{kind}": [round(share, 4) for share in shares]
            for kind, shares in success_by_level.items()
        },
    )
    print(f"written to {written}")


def beside_teacher(
    teacher: Policy,
    success_by_level: Mapping[str, list[float]],
    *,
    success: float,
    num_envs: int,
) -> dict[str, float]:
    """Return `share_of_teacher` and `weakest` of a policy with these successes, as the teacher walks its own course.

    `success` is the policy's in all, of the same `summary`; `lost_worlds` are the teacher's.

    Raises:
        ValueError: if the teacher's ground has other kinds or levels, or it arrives nowhere.
    """
    course = course_of(teacher.cfg.task)
    outcomes = walk(teacher, course, num_envs=num_envs)
    theirs, own = summary(outcomes, kinds=course.grid.columns, num_levels=course.grid.num_levels)
    sizes = {kind: len(shares) for kind, shares in success_by_level.items()}
    if sizes != {kind: len(shares) for kind, shares in theirs.items()}:
        raise ValueError(
            f"teacher: its ground has {course.grid.num_levels} levels of {sorted(theirs)}, and the policy's has "
            f"{sizes}: take the run from which it learned"
        )
    if own["success"] == 0.0:
        raise ValueError("teacher: it arrives nowhere, so that there is nothing to compare with")
    return {
        "teacher_success": own["success"],
        "share_of_teacher": success / own["success"],
        "lost_worlds": outcomes.lost_worlds,
        "weakest": min(shares[-1] for shares in success_by_level.values()),
    }


def trained(path: Path, iteration: int) -> dict[str, float]:
    """Return `env_states` and `trained_level` of a policy from its run's log, as far as it has them.

    `path` is the run folder, its folder of checkpoints, or one of these.
    """
    table = next(
        (folder / METRICS for folder in (path, *path.parents[:2]) if (folder / METRICS).exists()),
        None,
    )
    if table is None:
        return {}
    _, rows = read_table(table)
    rows = [row for row in rows if int(float(row["iteration"])) <= iteration]
    env_states = int(rows[-1]["env_states"])
    last = [row for row in rows if int(row["env_states"]) > env_states - HELD_STATES]
    levels = [float(row[LEVEL]) for row in last if row.get(LEVEL)]
    return {"env_states": env_states} | (
        {"trained_level": statistics.fmean(levels)} if levels else {}
    )


def _table(
    title: str, figures: Mapping[str, float], success_by_level: Mapping[str, list[float]]
) -> Table:
    table = Table(title=f"{title}, {figures['num_envs']} envs")
    table.add_column("ground")
    for column in ("success", "fell", "levels", "success by level, %"):
        table.add_column(column, justify="right")
    for kind, shares in success_by_level.items():
        own = [f"{figures[f'{kind}/{name}']:.1%}" for name in ("success", "fell")]
        by_level = " ".join(f"{100 * share:3.0f}" for share in shares)
        table.add_row(kind, *own, f"{figures[f'{kind}/levels']:.0f}", by_level)
    table.add_row(
        "all", f"{figures['success']:.1%}", f"{figures['fell']:.1%}", f"{figures['levels']:.1f}", ""
    )
    return table


if __name__ == "__main__":
    command_line.run(main)
