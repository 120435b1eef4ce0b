"""Trains a task with some seeds, and keeps the curves.

    python -m benchmarks.learning_curve task=go1_velocity_flat seeds=1,2,3 env_states=30e6 num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`. Each seed is a process of its own; with several GPUs they run side by side.
Figures go to benchmarks/results/learning_<task>.json, with another objective than PPO or other modules than MLPs to
learning_<task>_<objective>_<modules>.json: the medians over the seeds of the episode means (of rewards: per second of
the longest episode) over the last million env states. The picture is beside it. The curve of a seed is kept there as
soon as the seed is done; if one fails, the others go on, and there are no medians.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.learning_picture import draw
from ksim_rl.runs.csv_table import read_table, thinned
from ksim_rl.trainers import RunCfg, RunProgress, run

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
OWN_OPTIONS = {"seeds": "1", "env_states": "", "points": ""}
AVERAGED_STATES = 1e6

Point = dict[str, float]


def main() -> None:
    """Train all seeds, print their curves, and write them; or, as one of the seeds, train."""
    own, overrides = command_line.split(sys.argv[1:], OWN_OPTIONS)
    cfg = run_cfg(overrides, own["env_states"])
    if own["points"]:
        Path(own["points"]).write_text(json.dumps(train_one(cfg)))
        return
    seeds = chosen_seeds(own, overrides)
    curves = train_and_keep(seeds, cfg=cfg, overrides=overrides)
    failed = [str(seed) for seed in seeds if seed not in curves]
    if failed:
        raise SystemExit(
            f"no medians, since the runs of seeds {','.join(failed)} failed; the others are kept"
        )


def chosen_seeds(own: dict[str, str], overrides: list[str]) -> list[int]:
    """Return the seeds to train.

    Raises:
        ValueError: if they are no whole numbers, or given as an override, which would not be heeded.
    """
    for word in overrides:
        if word.startswith("seed="):
            raise ValueError(f"{word}: choose seeds with seeds={word.removeprefix('seed=')}")
    return command_line.whole_numbers("seeds", own["seeds"], least=0)


def train_and_keep(
    seeds: list[int], *, cfg: RunCfg, overrides: list[str]
) -> dict[int, list[Point]]:
    """Train all seeds, keep the curve of each when it is done, print, write and draw all; return the curves.

    Without the seeds that failed, and without any medians if there are such.
    """
    device = cfg.resolved_device()
    label = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    others = other_choices(overrides)
    curves: dict[int, list[Point]] = {}

    def write(figures: dict[str, float]) -> Path:
        return report.write(
            "_".join(["learning", cfg.task_name, *others]),
            figures=figures,
            device=device,
            module="benchmarks.learning_curve",
            curves={
                f"{label}/seed_{seed}": thinned(points, KEPT_POINTS)
                for seed, points in curves.items()
            },
        )

    for seed, points in train_all(seeds):
        curves[seed] = points
        write({})
    if not curves:
        return curves
    Console(width=200).print(_table(label, curves))
    figures = summary(list(curves.values())) if len(curves) == len(seeds) else {}
    short = _short_names(figures) if figures and device.type == "cuda" else {}
    path = write({f"{label}/{figure}": value for figure, value in figures.items()} | short)
    learner = ", ".join(others) or "ppo"
    draw(
        curves,
        path.with_suffix(".png"),
        task_name=cfg.task_name,
        learner=learner,
        num_envs=cfg.num_envs,
    )
    print(f"written to {path}")
    return curves


def other_choices(overrides: list[str]) -> list[str]:
    """Return the objective and the modules that are chosen, without the usual ones, PPO and MLPs."""
    chosen = dict(
        word.split("=", 1) for word in overrides if word.startswith(("objective=", "modules="))
    )
    return [choice for choice in chosen.values() if choice not in ("ppo", "mlp")]


def train_one(cfg: RunCfg) -> list[Point]:
    """Train `cfg` and return the rows of its log that have finished episodes."""
    with tempfile.TemporaryDirectory() as folder:
        run(cfg, Path(folder), progress=RunProgress(cfg.trainer.num_iterations))
        _, rows = read_table(Path(folder) / "metrics.csv")
    ended = [row for row in rows if row.get("episode/return")]
    if not ended:
        raise ValueError(
            f"no episode ended within {cfg.trainer.num_iterations} iterations: raise env_states"
        )
    wanted = [name for name in ended[0] if name in KEPT or name.startswith("reward/")]
    return [{name: float(row[name]) for name in wanted if row.get(name)} for row in ended]


def summary(curves: list[list[Point]]) -> dict[str, float]:
    """Return the medians over the seeds at the end of their curves, and the seconds that took."""
    ends = []
    for points in curves:
        last = [
            point
            for point in points
            if point["env_states"] > points[-1]["env_states"] - AVERAGED_STATES
        ]
        ends.append(
            {name: statistics.fmean(point.get(name, 0.0) for point in last) for name in last[-1]}
        )
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


def train_all(seeds: list[int]) -> Iterator[tuple[int, list[Point]]]:
    """Train each seed in its own process, as many at a time as there are GPUs (one on the CPU); yield what they give.

    A seed whose process fails is left out, and said.
    """
    gpus = max(1, torch.cuda.device_count())
    words = [word for word in sys.argv[1:] if not word.startswith("seeds=")]
    with tempfile.TemporaryDirectory() as folder:
        for first in range(0, len(seeds), gpus):
            running = [
                (_start(words, seed, Path(folder) / f"{seed}.json", gpu), seed)
                for gpu, seed in enumerate(seeds[first : first + gpus])
            ]
            for process, seed in running:
                if process.wait():
                    print(
                        f"the run of seed {seed} ended with exit code {process.returncode}",
                        flush=True,
                    )
                else:
                    yield seed, json.loads((Path(folder) / f"{seed}.json").read_text())


def _start(words: list[str], seed: int, points: Path, gpu: int) -> subprocess.Popen[bytes]:
    command = [
        sys.executable,
        "-m",
        "benchmarks.learning_curve",
        *words,
        f"seed={seed}",
        f"points={points}",
    ]
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    own = visible.split(",")[gpu] if visible else str(gpu)
    return subprocess.Popen(command, env=os.environ | {"CUDA_VISIBLE_DEVICES": own})


def run_cfg(overrides: list[str], env_states: str) -> RunCfg:
    """Compose a seed's config as `ksim-rl train` does, with what this benchmark needs, for so many env states.

    Raises:
        ValueError: naming the override that is wrong.
    """
    fixed = [
        "logger=local",
        "trainer.checkpoint_interval=0",
        "trainer.video=false",
        "trainer.eval_episodes=0",
    ]
    cfg = command_line.compose([*overrides, *fixed])
    if not env_states:
        return cfg
    try:
        wanted = int(float(env_states))
    except ValueError as error:
        raise ValueError(f"env_states={env_states}: expected a number, such as 30e6") from error
    iterations = -(-wanted // (cfg.num_envs * cfg.data.rollout_length(cfg.num_envs)))
    return command_line.compose([*overrides, *fixed, f"trainer.num_iterations={iterations}"])


def _table(title: str, curves: dict[int, list[Point]]) -> Table:
    table = Table(title=title)
    names: list[Any] = list(next(iter(curves.values()))[-1])
    for name in ("seed", *names):
        table.add_column(name.removeprefix("reward/"))
    for seed, points in curves.items():
        for point in thinned(points, 6):
            table.add_row(str(seed), *(f"{point.get(name, float('nan')):.4g}" for name in names))
    return table


if __name__ == "__main__":
    command_line.run(main)
