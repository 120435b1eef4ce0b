"""Rows that need a GPU; without one they are not measured, and never count as passed."""

from __future__ import annotations

import dataclasses
import re
import time
from pathlib import Path

import torch

from benchmarks.faults.growth import memory
from benchmarks.faults.row import AT_LEAST, AT_MOST, EXACTLY, Figures, Row
from benchmarks.faults.saving import same_bits
from ksim_rl import conf
from ksim_rl.trainers import Hook, RunProgress, Trainer, run_folder
from ksim_rl.trainers.build import build

GO1 = ("task=go1_velocity_flat", "device=cuda", "trainer.eval_episodes=0", "trainer.video=false")
ALGORITHMS = ("ppo", "sac", "fast_sac")
# What "flat" allows while a run of minutes goes on, in bytes.
FLAT = 16 * 2**20


class _Speed(Hook):
    """Keeps time, env states and memory of host and device, and ends the run when the time is up."""

    interval = 10

    def __init__(self, seconds: int) -> None:
        self.seconds, self.began = seconds, None
        self.rows: list[tuple[float, int, int, int]] = []

    def __call__(self, trainer: Trainer) -> None:
        now = time.monotonic()
        self.began = now if self.began is None else self.began
        device = torch.cuda.memory_reserved()
        self.rows.append((now - self.began, trainer.env_states, memory(), device))
        if now - self.began > self.seconds:
            trainer.cfg = dataclasses.replace(trainer.cfg, num_iterations=trainer.iteration)

    def speed(self, begin: float, end: float) -> float:
        inside = [row for row in self.rows if begin <= row[0] <= end]
        return (inside[-1][1] - inside[0][1]) / (inside[-1][0] - inside[0][0])


def gpu_soak(folder: Path, *, seconds: int) -> Figures:
    """Train Go1 with all that its task has, logs and checkpoints, and compare the last minute with the first."""
    watch = _Speed(seconds)
    cfg = conf.compose(
        [*GO1, "num_envs=4096", "trainer.num_iterations=1000000", "trainer.checkpoint_interval=200"]
    )
    run_folder.run(cfg, folder / "run", progress=RunProgress(1, enabled=False), hooks=(watch,))
    part = min(60.0, seconds / 4)
    half = [row for row in watch.rows if row[0] >= seconds / 2]
    return {
        "seconds": watch.rows[-1][0],
        "last_speed_over_first": watch.speed(seconds - part, seconds) / watch.speed(0.0, part),
        "host_memory_rise": half[-1][2] - half[0][2],
        "device_memory_rise": half[-1][3] - half[0][3],
    }


def gpu_memory(folder: Path) -> Figures:
    """Ask for far more envs than fit, with three algorithms; then train with the number that the message names."""
    told = ran = 0
    for name in ALGORITHMS:
        overrides = [*GO1, f"objective={name}", "logger=none", "trainer.num_iterations=1"]
        try:
            cfg = conf.compose([*overrides, f"num_envs={2**22}"])
            run_folder.run(cfg, folder / name, progress=RunProgress(1, enabled=False))
        except (ValueError, RuntimeError) as error:
            fits = re.search(r"enough for ([0-9]+)", str(error))
            told += "one env takes at least" in str(error) and "\n" not in str(error) and fits is not None
            if fits is None:
                continue
            torch.cuda.empty_cache()
            power = 2 ** (int(fits[1]).bit_length() - 1)  # of two, as the sizes of minibatches are
            cfg = conf.compose([*overrides, f"num_envs={power}"])
            run_folder.run(cfg, folder / f"{name}_fits", progress=RunProgress(1, enabled=False))
            ran += 1
    return {"algorithms": len(ALGORITHMS), "told": told, "that_number_runs": ran}


def gpu_same_seed(folder: Path, *, iterations: int) -> Figures:
    """Train twice from one seed, and compare every tensor."""
    states = []
    for _ in range(2):
        trainer = build(conf.compose([*GO1, "num_envs=1024", "logger=none"]))
        for _ in range(iterations):
            trainer.iterate()
        trainer.settle()
        states.append(trainer.state_dict())
        trainer.collector.env.close(raise_if_closed=False)
    return {"iterations": iterations, "differ": same_bits(*states)}


ROWS = {
    "gpu_soak": Row(
        fault="8 minutes of Go1 with randomization, curricula, logs and checkpoints",
        must="memory of host and device flat; the last minute within 2 % of the first one's speed",
        limits={
            "seconds": (AT_LEAST, "seconds"),
            "last_speed_over_first": (AT_LEAST, 0.98),
            "host_memory_rise": (AT_MOST, FLAT),
            "device_memory_rise": (AT_MOST, FLAT),
        },
        measure=gpu_soak,
        amounts={"seconds": 480},
        short={"seconds": 30},
        device="cuda",
        files=("ksim_rl/trainers", "ksim_rl/envs", "ksim_rl/physics"),
    ),
    "gpu_memory": Row(
        fault="more envs than the memory of the GPU holds, with three algorithms",
        must="one message with bytes per world and a num_envs that fits, which then runs",
        limits={"algorithms": (EXACTLY, 3), "told": (EXACTLY, 3), "that_number_runs": (EXACTLY, 3)},
        measure=gpu_memory,
        device="cuda",
        files=("ksim_rl/device/memory.py",),
    ),
    "gpu_same_seed": Row(
        fault="the same seed twice on a GPU",
        must="all tensors identical after 200 iterations",
        limits={"iterations": (AT_LEAST, "iterations"), "differ": (EXACTLY, 0)},
        measure=gpu_same_seed,
        amounts={"iterations": 200},
        short={"iterations": 5},
        device="cuda",
        files=("ksim_rl/physics", "ksim_rl/device"),
    ),
}
