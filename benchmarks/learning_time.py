"""How long training takes until the policy follows its command as well as the peer's does.

    python -m benchmarks.learning_time task=go1_velocity_flat seeds=1,2,3 env_states=60e6 device=cuda

takes the overrides of `ksim-rl train`. Each seed is trained as in `benchmarks.learning_curve`; the seconds are those of
training (collecting, learning, logging) up to the first point of the curve from which on, for `HELD_STATES` env states,
the mean of each of `LEVELS` is at least its level. Figures go to benchmarks/results/learning_time.json:
`seconds_to_track`, the median over the seeds, and `env_states_to_track`; with another objective than PPO or other
modules than MLPs under the names of those. A seed that does not get there counts as infinite; with most seeds infinite
there is no figure, and the command fails. The curves are kept as `benchmarks.learning_curve` keeps them.
"""

from __future__ import annotations

import math
import statistics
import sys

from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.learning_curve import OWN_OPTIONS, Point, keep, other_choices, run_cfg, train_all

# What mjlab 1.6.0 with rsl_rl 5.4.2 reaches after 30 M env states, in 192 s on an H200.
LEVELS = {"reward/track_linear_velocity": 1.39, "reward/track_angular_velocity": 1.20}
HELD_STATES = 1e6


def reached(points: list[Point]) -> Point | None:
    """Return the first point from which on all levels hold in the mean of the next `HELD_STATES` env states."""
    for index, point in enumerate(points):
        end = point["env_states"] + HELD_STATES
        held = [other for other in points[index:] if other["env_states"] <= end]
        if points[-1]["env_states"] < end:
            return None
        if all(
            statistics.fmean(p.get(name, -math.inf) for p in held) >= level for name, level in LEVELS.items()
        ):
            return held[-1]
    return None


def main() -> None:
    """Train all seeds, say when each got there, and write the medians."""
    own = dict(word.split("=", 1) for word in sys.argv[1:] if word.partition("=")[0] in OWN_OPTIONS)
    overrides = [word for word in sys.argv[1:] if word.partition("=")[0] not in OWN_OPTIONS]
    seeds = [int(seed) for seed in own.get("seeds", "1,2,3").split(",")]
    cfg = run_cfg(overrides, own)
    device = cfg.resolved_device()
    curves = dict(zip(seeds, train_all(seeds), strict=True))
    keep(curves, cfg=cfg, overrides=overrides, module="benchmarks.learning_time")
    ends = {seed: reached(points) for seed, points in curves.items()}
    table = Table(title=f"{cfg.task_name}: until {', '.join(f'{k} >= {v}' for k, v in LEVELS.items())}")
    for column in ("seed", "seconds", "env states"):
        table.add_column(column, justify="right")
    for seed, end in ends.items():
        cells = ("not reached", "") if end is None else (f"{end['seconds']:.1f}", f"{end['env_states']:,.0f}")
        table.add_row(str(seed), *cells)
    Console().print(table)
    figures = {
        f"{name}_to_track": statistics.median(math.inf if end is None else end[name] for end in ends.values())
        for name in ("seconds", "env_states")
    }
    if math.isinf(figures["seconds_to_track"]):
        raise SystemExit("most seeds did not get there: raise env_states")
    others = other_choices(overrides)
    prefix = "/".join([report.device_label(device), cfg.task_name, str(cfg.num_envs), *others])
    rounded = {name: round(value, 2) for name, value in figures.items()}
    path = report.write(
        "learning_time",
        figures={f"{prefix}/{name}": value for name, value in rounded.items()} | ({} if others else rounded),
        device=device,
        module="benchmarks.learning_time",
        seconds_of_seeds={
            f"{prefix}/seed_{seed}": None if end is None else round(end["seconds"], 2)
            for seed, end in ends.items()
        },
    )
    print(f"written to {path}")


if __name__ == "__main__":
    main()
