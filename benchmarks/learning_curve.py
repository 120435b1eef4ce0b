"""How a task is learned: trains it, and keeps the curve.

    python -m benchmarks.learning_curve task=go1_velocity_flat num_envs=4096 device=cuda trainer.num_iterations=306

takes the overrides of `ksim-rl train`. The curve goes to benchmarks/results/learning_curve.json, the picture beside it.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks import report
from ksim_rl import conf
from ksim_rl.trainers import RunCfg, RunProgress, curves, run
from ksim_rl.trainers.loggers.csv_table import read_table

POINTS = 60
KEPT = ("env_states", "seconds", "episode/return", "episode/length", "throughput/env_states_per_s")


def measure(cfg: RunCfg, picture: Path) -> list[dict[str, float]]:
    """Train `cfg`, draw its curves into `picture`, and return the rows of its log that have finished episodes."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = run(cfg, Path(folder), progress=RunProgress(cfg.trainer.num_iterations))
        table = Path(folder) / "metrics.csv"
        picture.parent.mkdir(parents=True, exist_ok=True)
        curves.draw(table, picture, title=f"{cfg.task_name}: {cfg.num_envs} envs, seed {cfg.seed}")
        _, rows = read_table(table)
    wanted = [name for name in rows[0] if name in KEPT or name.startswith("reward/")]
    points = [
        {name: float(row[name]) for name in wanted if row.get(name)}
        for row in rows
        if row.get("episode/return")
    ]
    if outcome.evaluation is not None:
        points[-1]["evaluation/return_mean"] = outcome.evaluation.return_mean
    return points


def main() -> None:
    """Train, print the curve at some points, and write it."""
    cfg = conf.compose(
        [*sys.argv[1:], "logger=local", "trainer.checkpoint_interval=0", "trainer.video=false"]
    )
    device = cfg.resolved_device()
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    points = measure(cfg, report.RESULTS / f"learning_curve_{cfg.task_name}.png")
    last = points[-1]
    table = Table(title=prefix)
    for name in last:
        table.add_column(name)
    for point in points[:: max(1, len(points) // 12)] + [last]:
        table.add_row(*(f"{point.get(name, float('nan')):.4g}" for name in last))
    Console(width=220).print(table)
    path = report.write(
        "learning_curve",
        figures={f"{prefix}/{name}": round(value, 4) for name, value in last.items()},
        device=device,
        module="benchmarks.learning_curve",
        curves={prefix: points[:: max(1, len(points) // POINTS)] + [last]},
    )
    print(f"written to {path}")


if __name__ == "__main__":
    main()
