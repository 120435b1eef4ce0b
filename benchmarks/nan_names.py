"""Times what names a term that gives NaN: the looks at the terms' values, beside a whole iteration.

    python -m benchmarks.nan_names task=go1_velocity_flat num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`. The looks of one env step, at rewards, metrics, commands and observations, are
recorded with the tables that they look at, and timed alone, as a graph on CUDA; their share is of a training iteration.
On the CPU the time is the processor's, so that other programs do not count. Exit code 1: more than 0.5 %.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import torch

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl.device.capture import Captured
from ksim_rl.trainers import RunCfg, Trainer, build

MOST_SHARE = 0.005
# Looks that are timed as one, as a single one takes microseconds; iterations that are timed, after the first ones.
LOOKS, ITERATIONS, WARMUP = 200, {"cpu": 3, "cuda": 10}, {"cpu": 1, "cuda": 12}


def looks_of_a_step(trainer: Trainer) -> list[tuple[Any, ...]]:
    """Return the arguments of each look in one env step."""
    env: Any = trainer.collector.env
    names, found = env.base_env.driver.non_finite, []
    root = env.reset()
    action = trainer.collector.policy(root.copy())["action"]
    names.watch = lambda *arguments: found.append(arguments)
    try:
        env.step_and_maybe_reset(root.set("action", action))
    finally:
        del names.watch
    return found


def measure(cfg: RunCfg) -> dict[str, float]:
    """Time iterations, and the looks of all their env steps."""
    trainer, device = build(cfg), cfg.resolved_device()
    for _ in range(WARMUP[device.type]):
        trainer.iterate()
    iteration_ms = _milliseconds(trainer.iterate, device, ITERATIONS[device.type])
    with torch.no_grad():
        looks = looks_of_a_step(trainer)
    env: Any = trainer.collector.env
    names = env.base_env.driver.non_finite

    def look() -> None:
        for arguments in looks:
            names.watch(*arguments)

    captured = Captured(look, device=device, warmup=2)
    for _ in range(4):
        captured()

    def often() -> None:
        for _ in range(LOOKS):
            captured()

    step_ms = _milliseconds(often, device, 5) / LOOKS
    return {
        "looks": len(looks),
        "looks_of_a_step_ms": step_ms,
        "iteration_ms": iteration_ms,
        "share": step_ms * cfg.data.rollout_length(cfg.num_envs) / iteration_ms,
    }


def _milliseconds(work: Any, device: torch.device, repeats: int) -> float:
    if device.type == "cuda":
        return milliseconds(work, device=device, repeats=repeats)
    began = time.process_time()
    for _ in range(repeats):
        work()
    return 1000.0 * (time.process_time() - began) / repeats


def main() -> int:
    """Measure, print, and write benchmarks/results/nan_names.json."""
    cfg = command_line.compose([*sys.argv[1:], "logger=none", "trainer.eval_episodes=0"])
    device = cfg.resolved_device()
    figures = measure(cfg)
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    report.write(
        "nan_names",
        figures={f"{prefix}/{name}": round(value, 6) for name, value in figures.items()},
        device=device,
        module="benchmarks.nan_names",
        limits={f"{prefix}/share": f"at most {MOST_SHARE}"},
    )
    print(", ".join(f"{name} {value:.4g}" for name, value in figures.items()), flush=True)
    return int(figures["share"] > MOST_SHARE)


if __name__ == "__main__":
    command_line.run(main)
