"""Rows that need a GPU; without one they are not measured, and never count as passed."""

from __future__ import annotations

import dataclasses
import gc
import re
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks import determinism
from benchmarks.faults.growth import memory
from benchmarks.faults.numbers import count_non_finite
from benchmarks.faults.row import AT_LEAST, AT_MOST, EXACTLY, Figures, Row
from ksim_rl import conf
from ksim_rl.physics import World
from ksim_rl.trainers import Hook, RunProgress, Trainer, run_folder
from ksim_rl.trainers.build import build_env

GO1 = ("task=go1_velocity_flat", "device=cuda", "trainer.eval_episodes=0", "trainer.video=false")
# Envs that are asked for, and settings. Half of them (with PPO and SAC) or an eighth leave a good tenth of the memory,
# so that one number is tried: each takes a process, which spends most of its time before it trains.
ALGORITHMS = {
    "ppo": (49152, "collector.rollout_length=24"),
    # With the steps of a run's replay, hardly an env would fit.
    "sac": (40960, "data.capacity=256"),
    # Its own replay of 1024 steps is nine tenths of what an env takes. The batches of 48 gradient steps would take
    # gigabytes beside it, however few the envs are, and compiling takes a minute each time.
    "fast_sac": (61440, "objective.compile=false", "data.num_minibatches=4"),
}
ROOM = 8 * 2**30
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
        free, total = torch.cuda.mem_get_info()
        self.rows.append((now - self.began, trainer.env_states, memory(), total - free))
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
    last = watch.speed(seconds - part, seconds)
    return {
        "seconds": watch.rows[-1][0],
        "last_speed_over_first": last / watch.speed(0.0, part),
        "last_speed_over_second": last
        / watch.speed(part, 2 * part),  # the first one sees robots that fall
        "host_memory_rise": half[-1][2] - half[0][2],
        "device_memory_rise": half[-1][3] - half[0][3],
    }


def gpu_memory(folder: Path) -> Figures:
    """Ask for more envs than fit, with three algorithms; then train with the number that the message names."""
    told = ran = 0
    for name, (asked, *own) in ALGORITHMS.items():
        overrides = [*GO1, f"objective={name}", "logger=none", "trainer.num_iterations=10", *own]
        # A GPU of 8 GB, so that what fits is soon trained.
        taken = torch.empty(
            max(0, torch.cuda.mem_get_info()[0] - ROOM), dtype=torch.uint8, device="cuda"
        )
        fits, began = None, time.monotonic()
        try:
            cfg = conf.compose([*overrides, f"num_envs={asked}"])
            run_folder.run(cfg, folder / name, progress=RunProgress(1, enabled=False))
        except ValueError as error:
            fits = re.search(r"num_envs=([0-9]+) was tried and fits", str(error))
            told += (
                "one env takes at least" in str(error)
                and "\n" not in str(error)
                and fits is not None
            )
            print(f"{name}, after {time.monotonic() - began:.0f} s: {error}", flush=True)
        gc.collect()
        torch.cuda.empty_cache()
        if fits is not None:
            cfg = conf.compose([*overrides, f"num_envs={fits[1]}"])
            run_folder.run(cfg, folder / f"{name}_fits", progress=RunProgress(1, enabled=False))
            ran += 1
            print(
                f"{name}: num_envs={fits[1]} has run after {time.monotonic() - began:.0f} s",
                flush=True,
            )
        del taken
        gc.collect()
        torch.cuda.empty_cache()
    return {"algorithms": len(ALGORITHMS), "told": told, "that_number_runs": ran}


def _world(env: Any) -> World:
    return env.base_env.world


def gpu_nan_worlds(folder: Path, *, envs: int, device: str = "cuda") -> Figures:
    """Break the state of a third of the worlds of walking robots, beside an equal env that is whole."""
    cfg = conf.compose(["task=go1_velocity_flat", f"device={device}", f"num_envs={envs}"])
    both = [build_env(cfg, num_envs=envs, seed=1) for _ in range(2)]
    broken_E = torch.arange(envs, device=device) % 3 == 0
    roots = [env.reset() for env in both]
    no_numbers = torch.tensor([torch.nan, torch.inf, -torch.inf], device=device).repeat(envs)
    _world(both[1]).qvel_EL[broken_E, 0] = no_numbers[: int(broken_E.sum())]
    ended = non_finite = 0
    for step in range(10):
        for number, env in enumerate(both):
            action = torch.zeros_like(env.action_spec.rand())
            state_E, roots[number] = env.step_and_maybe_reset(roots[number].set("action", action))
        if step == 0:
            ended = int(state_E["next", "terminated"][broken_E].sum())
        non_finite += count_non_finite(state_E)
    whole_EL, other_EL = (torch.cat([_world(env).qpos_EL, _world(env).qvel_EL], -1) for env in both)
    return {
        "broken": int(broken_E.sum()),
        "not_ended_within_one_step": int(broken_E.sum()) - ended,
        "non_finite_in_the_dataset": non_finite,
        "others_that_differ": int((whole_EL != other_EL).any(-1)[~broken_E].sum()),
    }


def gpu_same_seed(folder: Path, *, iterations: int) -> Figures:
    """Train twice from one seed, and compare every tensor as `benchmarks.determinism` does."""
    cfg = conf.compose([*GO1, "num_envs=1024", "logger=none"])
    figures, _, lines = determinism.compare(cfg, runs=2, iterations=iterations)
    print(*lines, sep="\n", flush=True)
    return {"iterations": iterations, "differ": figures["tensors_that_differ"]}


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
        files=("ksim_rl/device/memory.py", "ksim_rl/trainers/trial.py"),
    ),
    "gpu_nan_worlds": Row(
        fault="NaN and infinities in the physics of a third of the worlds, on a GPU",
        must="these end within one step; nothing non-finite enters the dataset; the others are bit-identical to those "
        "beside whole ones",
        limits={
            "broken": (AT_LEAST, 4),
            **dict.fromkeys(
                ("not_ended_within_one_step", "non_finite_in_the_dataset"), (EXACTLY, 0)
            ),
            "others_that_differ": (EXACTLY, 0),
        },
        measure=gpu_nan_worlds,
        amounts={"envs": 384},
        device="cuda",
        files=("ksim_rl/physics/world.py", "ksim_rl/envs/manager_based_rl_env.py"),
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
