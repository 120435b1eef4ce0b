"""How a task is learned: trains it with some seeds, and keeps the curves.

    python -m benchmarks.learning_curve task=go1_velocity_flat seeds=1,2,3 env_states=30e6 num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`. Each seed is a process of its own; with several GPUs they run side by side.
Figures go to benchmarks/results/learning_<task>.json, with another objective than PPO or other modules than MLPs to
learning_<task>_<objective>_<modules>.json: the medians over the seeds of the episode means (of rewards: per second of
the longest episode) over the last million env states. The picture is beside it.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import report
from benchmarks.learning_picture import draw
from ksim_rl import conf
from ksim_rl.trainers import RunCfg, RunProgress, run
from ksim_rl.trainers.loggers.csv_table import read_table

KEPT_POINTS = 60
KEPT = (
    "env_states",
    "seconds",
    "episode/return",
    "episode/length",
    "throughput/env_states_per_s",
    "metric/pose_distance",
    "update/action_error",
)
OWN_OPTIONS = ("seeds", "env_states", "points")
AVERAGED_STATES = 1e6

Point = dict[str, float]


def main() -> None:
    """Train all seeds, print their curves, and write them; or, as one of the seeds, train."""
    own = {
        key: value for key, _, value in (word.partition("=") for word in sys.argv[1:]) if key in OWN_OPTIONS
    }
    overrides = [word for word in sys.argv[1:] if word.partition("=")[0] not in OWN_OPTIONS]
    if "points" in own:
        Path(own["points"]).write_text(json.dumps(train_one(run_cfg(overrides, own))))
        return
    seeds = [int(seed) for seed in own.get("seeds", "1").split(",")]
    cfg = run_cfg(overrides, own)
    curves = dict(zip(seeds, train_all(seeds), strict=True))
    print(f"written to {keep(curves, cfg=cfg, overrides=overrides, module='benchmarks.learning_curve')}")


def keep(curves: dict[int, list[Point]], *, cfg: RunCfg, overrides: list[str], module: str) -> Path:
    """Print the curves of the seeds, write and draw them, and return the file."""
    device = cfg.resolved_device()
    figures = summary(list(curves.values()))
    label = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    Console(width=200).print(_table(label, curves))
    others = other_choices(overrides)
    path = report.write(
        "_".join(["learning", cfg.task_name, *others]),
        figures={f"{label}/{figure}": value for figure, value in figures.items()} | _short_names(figures),
        device=device,
        module=module,
        curves={
            f"{label}/seed_{seed}": points[:: max(1, len(points) // KEPT_POINTS)] + [points[-1]]
            for seed, points in curves.items()
        },
    )
    learner = ", ".join(others) or "ppo"
    draw(curves, path.with_suffix(".png"), task_name=cfg.task_name, learner=learner, num_envs=cfg.num_envs)
    return path


def other_choices(overrides: list[str]) -> list[str]:
    """Return the objective and the modules that are chosen, without the usual ones, PPO and MLPs."""
    chosen = dict(word.split("=", 1) for word in overrides if word.startswith(("objective=", "modules=")))
    return [choice for choice in chosen.values() if choice not in ("ppo", "mlp")]


def train_one(cfg: RunCfg) -> list[Point]:
    """Train `cfg` and return the rows of its log that have finished episodes."""
    with tempfile.TemporaryDirectory() as folder:
        run(cfg, Path(folder), progress=RunProgress(cfg.trainer.num_iterations))
        _, rows = read_table(Path(folder) / "metrics.csv")
    wanted = [name for name in rows[0] if name in KEPT or name.startswith("reward/")]
    return [
        {name: float(row[name]) for name in wanted if row.get(name)}
        for row in rows
        if row.get("episode/return")
    ]


def summary(curves: list[list[Point]]) -> dict[str, float]:
    """Return the medians over the seeds at the end of their curves, and the seconds that took."""
    ends = []
    for points in curves:
        last = [point for point in points if point["env_states"] > points[-1]["env_states"] - AVERAGED_STATES]
        ends.append({name: statistics.fmean(point.get(name, 0.0) for point in last) for name in last[-1]})
        ends[-1] |= {name: points[-1][name] for name in ("env_states", "seconds")}
    return {
        name.removeprefix("reward/"): round(statistics.median(end[name] for end in ends), 4)
        for name in ends[0]
    }


def _short_names(figures: dict[str, float]) -> dict[str, float]:
    """Return the tracking rewards under the names that say after how many env states: `track_linear_at_30M`."""
    millions = round(figures["env_states"] / 1e6)
    return {
        f"{name.removesuffix('_velocity')}_at_{millions}M": figures[name]
        for name in ("track_linear_velocity", "track_angular_velocity")
        if name in figures
    }


def train_all(seeds: list[int]) -> list[list[Point]]:
    """Train each seed in its own process, as many at a time as there are GPUs (one on the CPU)."""
    gpus = max(1, torch.cuda.device_count())
    words = [word for word in sys.argv[1:] if not word.startswith("seeds=")]
    found: list[list[Point]] = []
    with tempfile.TemporaryDirectory() as folder:
        for first in range(0, len(seeds), gpus):
            running = [
                (_start(words, seed, Path(folder) / f"{seed}.json", gpu), seed)
                for gpu, seed in enumerate(seeds[first : first + gpus])
            ]
            for process, seed in running:
                if process.wait():
                    for other, _ in running:
                        other.terminate()
                    raise RuntimeError(f"the run of seed {seed} ended with exit code {process.returncode}")
                found.append(json.loads((Path(folder) / f"{seed}.json").read_text()))
    return found


def _start(words: list[str], seed: int, points: Path, gpu: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "benchmarks.learning_curve", *words, f"seed={seed}", f"points={points}"]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    own = visible.split(",")[gpu] if visible else str(gpu)
    return subprocess.Popen(command, env=os.environ | {"CUDA_VISIBLE_DEVICES": own})


def run_cfg(overrides: list[str], own: dict[str, str]) -> RunCfg:
    fixed = [
        "logger=local",
        "trainer.checkpoint_interval=0",
        "trainer.video=false",
        "trainer.eval_interval=0",
    ]
    cfg = conf.compose([*overrides, *fixed])
    if "env_states" not in own:
        return cfg
    per_iteration = cfg.num_envs * cfg.data.rollout_length(cfg.num_envs)
    iterations = -(-int(float(own["env_states"])) // per_iteration)
    return conf.compose([*overrides, *fixed, f"trainer.num_iterations={iterations}"])


def _table(title: str, curves: dict[int, list[Point]]) -> Table:
    table = Table(title=title)
    names: list[Any] = list(next(iter(curves.values()))[-1])
    for name in ("seed", *names):
        table.add_column(name.removeprefix("reward/"))
    for seed, points in curves.items():
        for point in [*points[:: max(1, len(points) // 6)], points[-1]]:
            table.add_row(str(seed), *(f"{point.get(name, float('nan')):.4g}" for name in names))
    return table


if __name__ == "__main__":
    main()
