"""This benchmark times training until the policy follows its command as well as the peer's does.

    python -m benchmarks.learning_time task=go1_velocity_flat seeds=1,2,3 env_states=60e6 device=cuda

takes the overrides of `ksim-rl train`. Each seed is trained as in `benchmarks.learning_curve`; the seconds are those of
training (collecting, learning, logging) up to the end of the first million env states over which the mean of each
of `LEVELS` (or of `TWO_LEGS`) is at least its level. Figures go to benchmarks/results/learning_time.json:
`seconds_to_track`, the median over the seeds, and `env_states_to_track`, with another objective than PPO or other
modules than MLPs under the names of those; and `seconds_of_seeds`. A seed that does not get there counts as infinite;
with most seeds infinite, or where one failed, there is no median, and the command fails. Curves are kept as
`benchmarks.learning_curve` keeps them.
"""

from __future__ import annotations

import math
import statistics
import sys

from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.learning_curve import (
    OWN_OPTIONS,
    chosen_seeds,
    fail_without,
    other_choices,
    run_cfg,
    train_and_keep,
)
from ksim_rl.tables.levels import Point, reached

# What mjlab 1.6.0 with rsl_rl 5.4.2 reaches after 30 M env states, in 192 s on an H200.
LEVELS = {"reward/track_linear_velocity": 1.39, "reward/track_angular_velocity": 1.20}
# The peer has no level for robots on two legs: after 30 M env states its G1 falls at once.
TWO_LEGS = {"reward/track_linear_velocity": 1.40, "reward/track_angular_velocity": 1.00}
LEVELS_OF = {"g1_velocity_flat": TWO_LEGS, "t1_velocity_flat": TWO_LEGS, "humanoid_velocity_flat": TWO_LEGS}
# On a GPU its medians, with PPO and MLPs, stand in the results by their names alone.
TASK = "go1_velocity_flat"


def medians(ends: dict[int, Point | None]) -> dict[str, float]:
    """Return the medians over the seeds, or nothing where one is infinite, since most did not get there."""
    figures = {
        f"{name}_to_track": statistics.median(math.inf if end is None else end[name] for end in ends.values())
        for name in ("seconds", "env_states")
    }
    return {name: round(value, 2) for name, value in figures.items() if math.isfinite(value)}


def main() -> None:
    """Train all seeds, say when each got there, and write the medians."""
    own, overrides = command_line.split(sys.argv[1:], OWN_OPTIONS | {"seeds": "1,2,3"})
    seeds, cfg = chosen_seeds(own, overrides), run_cfg(overrides, own["env_states"])
    levels = LEVELS_OF.get(cfg.task_name, LEVELS)
    for name in levels:
        if name.removeprefix("reward/") not in cfg.task.rewards:
            raise ValueError(f"task={cfg.task_name} has no {name}: choose a velocity task, such as {TASK}")
    device = cfg.resolved_device()
    curves = train_and_keep(seeds, cfg=cfg, overrides=overrides, module="benchmarks.learning_time")
    ends = {seed: reached(points, levels) for seed, points in curves.items()}
    table = Table(title=f"{cfg.task_name}: until {', '.join(f'{k} >= {v}' for k, v in levels.items())}")
    for column in ("seed", "seconds", "env states"):
        table.add_column(column, justify="right")
    for seed, end in ends.items():
        cells = ("not reached", "") if end is None else (f"{end['seconds']:.1f}", f"{end['env_states']:,.0f}")
        table.add_row(str(seed), *cells)
    Console().print(table)
    others = other_choices(overrides)
    prefix = "/".join([report.device_label(device), cfg.task_name, str(cfg.num_envs), *others])
    figures = medians(ends) if len(ends) == len(seeds) else {}
    is_target = device.type == "cuda" and cfg.task_name == TASK and not others
    path = report.write(
        "learning_time",
        figures={f"{prefix}/{name}": value for name, value in figures.items()}
        | (figures if is_target else {}),
        device=device,
        module="benchmarks.learning_time",
        seconds_of_seeds={
            f"{prefix}/seed_{seed}": None if end is None else round(end["seconds"], 2)
            for seed, end in ends.items()
        },
    )
    print(f"written to {path}")
    fail_without(seeds, curves)
    if not figures:
        raise SystemExit("most seeds did not get there: raise env_states")


if __name__ == "__main__":
    command_line.run(main)
