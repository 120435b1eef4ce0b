"""Times MuJoCo's C engine beside MuJoCo Warp on the CPU, by turns in one process.

    python -m benchmarks.engines task=go1_velocity_flat num_envs=64,512,4096 collector.rollout_length=8

takes the overrides of `ksim-rl train`. Whatever else the machine does slows both alike, but not quite: the C engine
waits for the slowest of its threads. So times are taken on the wall clock and as the processor time of all threads,
which is the wall clock's on one core without other load. Figures go to benchmarks/results/throughput.json.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.trainers import RunCfg, Trainer, build
from ksim_rl.trainers.run_cfg import with_engine

ENGINES = ("c", "warp")
# The first rollouts compile, record and compare.
WARM_UP = 3
REPEATS = 7
CPU = torch.device("cpu")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Times:
    """Medians of a call, ms: on the wall clock, and of all threads' processor time."""

    wall_ms: float
    processor_ms: float


def measure(cfg: RunCfg, *, repeats: int = REPEATS) -> dict[str, float]:
    """Time rollouts and physics of both engines; return medians in ms, and how much faster C is, by name.

    Rollouts run as in training, each engine with its own defaults: MuJoCo Warp's are compiled. Physics is one env
    step's substeps and the refresh after them.
    """
    trainers = {engine: build(with_engine(cfg, engine)) for engine in ENGINES}
    rollouts = {engine: trainers[engine].collector.collect for engine in ENGINES}
    physics = {engine: _physics(trainers[engine]) for engine in ENGINES}
    figures = _figures("rollout", _by_turns(rollouts, repeats))
    figures |= _figures("physics", _by_turns(physics, repeats))
    for trainer in trainers.values():
        trainer.collector.env.close(raise_if_closed=False)
    # The figure that counts in training.
    figures["engine_c_over_warp"] = figures["rollout_c_over_warp"]
    return figures


def table(cfg: RunCfg, figures: dict[str, float]) -> Table:
    """Return the figures as a table."""
    title = f"{cfg.task_name}, {cfg.num_envs} envs, {report.device_name(CPU)}: both engines"
    found = Table(title=title)
    for column in ("", "MuJoCo Warp, ms", "MuJoCo C, ms", "C is faster by", "by processor time"):
        found.add_column(column, justify="left" if not column else "right")
    for label, name in (("physics of an env step", "physics"), ("rollout with policy", "rollout")):
        own = figures[f"{name}_warp_ms"]
        other = figures[f"{name}_c_ms"]
        ratio = figures[f"{name}_c_over_warp"]
        processor = figures[f"{name}_c_over_warp_processor_time"]
        found.add_row(label, f"{own:.3f}", f"{other:.3f}", f"x {ratio:.2f}", f"x {processor:.2f}")
    return found


def main() -> None:
    """Measure each number of envs, print the tables, and write the figures."""
    options, overrides = command_line.split(sys.argv[1:], {"num_envs": "64,512,4096"})
    for num_envs in command_line.whole_numbers("num_envs", options["num_envs"]):
        words = [
            *overrides,
            f"num_envs={num_envs}",
            "device=cpu",
            "logger=none",
            "trainer.eval_episodes=0",
        ]
        cfg = command_line.compose(words)
        figures = measure(cfg)
        Console().print(table(cfg, figures))
        prefix = f"cpu/{cfg.task_name}/{num_envs}"
        path = report.write(
            "throughput",
            figures={f"{prefix}/{name}": round(value, 6) for name, value in figures.items()},
            device=CPU,
            module="benchmarks.engines",
        )
        print(f"written to {path}")


def _physics(trainer: Trainer) -> Callable[[], None]:
    env = part(trainer.collector.env, ManagerBasedRlEnv)
    assert env is not None  # the env of a config is ours

    def advance() -> None:
        env.world.step(env.cfg.decimation)
        env.world.refresh()

    return advance


def _figures(name: str, times: dict[str, Times]) -> dict[str, float]:
    ours = times["warp"]
    other = times["c"]
    return {
        f"{name}_c_ms": other.wall_ms,
        f"{name}_warp_ms": ours.wall_ms,
        f"{name}_c_over_warp": ours.wall_ms / other.wall_ms,
        f"{name}_c_over_warp_processor_time": ours.processor_ms / other.processor_ms,
    }


def _by_turns(calls: dict[str, Callable[[], Any]], repeats: int) -> dict[str, Times]:
    """Time each call as often, one after the other."""
    for call in calls.values():
        for _ in range(WARM_UP):
            call()
    wall: dict[str, list[float]] = {name: [] for name in calls}
    processor: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            used = time.process_time()
            began = time.perf_counter()
            call()
            wall[name].append(1000.0 * (time.perf_counter() - began))
            processor[name].append(1000.0 * (time.process_time() - used))
    return {
        name: Times(
            wall_ms=statistics.median(wall[name]), processor_ms=statistics.median(processor[name])
        )
        for name in calls
    }


if __name__ == "__main__":
    command_line.run(main)
