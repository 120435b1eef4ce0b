"""Times training, and the raw physics inside of it.

    python -m benchmarks.throughput task=go1_velocity_flat num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`, trains some iterations, and prints one table: raw physics (the decimation's
`mjw.step` calls of MuJoCo Warp as it is, as one graph, sensors in each, from states and controls recorded in this run),
this project's own substeps from the same states, the env step, the rollout, the update and the whole iteration, each in
env states/s and relative to raw physics. Below it: what the guards against overflow and non-finite states take of an
iteration, and on CUDA the kernels of a control step, the policy's included, the device memory per world, and the waits
and copies of the host in one iteration. On the CPU a second table sets MuJoCo's C engine beside MuJoCo Warp, by turns
in the same process, as `benchmarks.engines` does alone. Figures go to benchmarks/results/throughput.json. How long the
first iteration takes: `benchmarks.first_iteration`.
"""

from __future__ import annotations

import gc
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, engines, report
from benchmarks.host_traffic import cuda_events, host_traffic
from benchmarks.raw_physics import own_physics_ms, physics_ms, record_steps
from benchmarks.stopwatch import milliseconds
from ksim_rl.device.capture import Captured
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.trainers import RunCfg, Trainer, build
from ksim_rl.trainers.algorithm import make_update
from ksim_rl.trainers.run_cfg import with_engine


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How much is run before and while measuring."""

    warmup_iterations: int
    timed_iterations: int
    repeats: int


SCHEDULES = {
    "cuda": Schedule(warmup_iterations=12, timed_iterations=10, repeats=10),
    "cpu": Schedule(warmup_iterations=1, timed_iterations=2, repeats=2),
}


def measure(cfg: RunCfg) -> dict[str, float]:
    """Train some iterations of `cfg` on MuJoCo Warp and return the figures, ms and env states/s."""
    trainer = build(_on_warp(cfg))
    device = _world(trainer).device
    schedule = SCHEDULES[device.type]
    collector, update = trainer.collector, trainer.update
    for _ in range(cfg.collector.warmup + 2):
        collector.collect()
    memory = _bytes_per_world(trainer, cfg)
    for _ in range(schedule.warmup_iterations):
        update(collector.collect())
    memory |= _bytes_of_the_update(trainer, memory)

    iteration_ms = _iteration_ms(trainer, device, schedule.timed_iterations)
    rollout_ms = milliseconds(collector.collect, device=device, repeats=schedule.repeats)
    rollout_ET = collector.collect()
    update_ms = milliseconds(lambda: update(rollout_ET), device=device, repeats=schedule.repeats)
    steps = record_steps(collector)
    env_step_ms = _env_step_ms(trainer, device, schedule.repeats)
    guards_ms = _guards_ms(trainer, cfg.task.decimation, device, schedule.repeats)
    traffic: dict[str, float] = {}
    if device.type == "cuda":
        kernels = sum(event.get("cat") == "kernel" for event in cuda_events(collector.collect))
        traffic = {
            "kernels_per_control_step": kernels / collector.rollout_length,
            **host_traffic(trainer.iterate),
        }
    repeats = max(1, schedule.repeats // 3)
    own_ms = own_physics_ms(_world(trainer), cfg.task.decimation, steps, repeats=repeats)
    raw_ms = physics_ms(_world(trainer), cfg.task.decimation, steps, repeats=repeats)

    env_states_per_s = 1000.0 * num_env_states(cfg) / iteration_ms
    return {
        "physics_ms": raw_ms,
        "own_physics_ms": own_ms,
        "env_step_ms": env_step_ms,
        "rollout_ms": rollout_ms,
        "update_ms": update_ms,
        "iteration_ms": iteration_ms,
        "env_states_per_s": env_states_per_s,
        "iteration_over_physics": env_states_per_s / (1000.0 * cfg.num_envs / raw_ms),
        "iteration_over_own_physics": env_states_per_s / (1000.0 * cfg.num_envs / own_ms),
        "guards_share": guards_ms * cfg.data.rollout_length(cfg.num_envs) / iteration_ms,
        **memory,
        **traffic,
    }


def _on_warp(cfg: RunCfg) -> RunCfg:
    """Leave no choice of the engine: the other has no arrays of MuJoCo Warp to time."""
    if cfg.task.sim.engine == "auto":
        return with_engine(cfg, "warp")
    return cfg


def _bytes_per_world(trainer: Trainer, cfg: RunCfg) -> dict[str, float]:
    """Return the memory per world of MuJoCo Warp's arrays, and of what env and rollout hold beside them.

    The second is what torch has taken before the first update, without what an update takes when it is built.
    """
    world = _world(trainer)
    figures = {"physics_bytes_per_world": float(world.bytes_per_world())}
    if world.device.type == "cuda":
        before = torch.cuda.memory_allocated(world.device)
        another = make_update(cfg, trainer.collector.env)
        of_update = torch.cuda.memory_allocated(world.device) - before
        del another
        held = _reserved(world.device) - of_update
        figures["env_and_rollout_bytes_per_world"] = held / world.num_envs
    return figures


def _bytes_of_the_update(trainer: Trainer, memory: Mapping[str, float]) -> dict[str, float]:
    """Return the memory per world of networks, optimizer, dataset and activations."""
    world = _world(trainer)
    if world.device.type != "cuda":
        return {}
    held = _reserved(world.device) / world.num_envs
    return {"update_bytes_per_world": held - memory["env_and_rollout_bytes_per_world"]}


def _reserved(device: torch.device) -> int:
    gc.collect()
    torch.cuda.synchronize(device)
    torch.cuda.empty_cache()
    return torch.cuda.memory_reserved(device)


@torch.no_grad()
def _guards_ms(trainer: Trainer, decimation: int, device: torch.device, repeats: int) -> float:
    """Time what an env step does against overflow and non-finite states, alone."""
    world = _world(trainer)
    action_EL = torch.zeros(world.num_envs, world.ctrl_EL.shape[1], device=device)

    def guards() -> None:
        for _ in range(decimation):
            world.record_overflow()
        finite_E = action_EL.sum(-1).abs() < torch.inf
        finite_E = finite_E & ((world.qpos_EL.sum(-1) + world.qvel_EL.sum(-1)).abs() < torch.inf)
        world.reset(~finite_E)

    captured = Captured(guards, device=device, warmup=2)
    for _ in range(4):
        captured()
    return milliseconds(captured, device=device, repeats=4 * repeats)


def num_env_states(cfg: RunCfg) -> int:
    """Return the env states of one iteration."""
    return cfg.num_envs * cfg.data.rollout_length(cfg.num_envs)


def train_ms(cfg: RunCfg, *, iterations: int) -> float:
    """Train so many iterations with the logs of `cfg`; return the median time of the second half of them, ms."""
    with tempfile.TemporaryDirectory() as folder:
        trainer = build(_on_warp(cfg), run_folder=Path(folder))
        for _ in range(iterations - iterations // 2):
            trainer.iterate()
        median_ms = _iteration_ms(trainer, _world(trainer).device, iterations // 2)
        for logger in trainer.loggers:
            logger.close()
    return median_ms


def iteration_ms(trainer: Trainer) -> float:
    """Warm up and return the median time of an iteration, ms."""
    device = _world(trainer).device
    schedule = SCHEDULES[device.type]
    for _ in range(schedule.warmup_iterations):
        trainer.iterate()
    return _iteration_ms(trainer, device, schedule.timed_iterations)


def _iteration_ms(trainer: Trainer, device: torch.device, iterations: int) -> float:
    """Time whole iterations on the wall clock, with the copy of their metrics and the trainer's loggers, if any."""
    times = []
    for _ in range(iterations):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        began = time.perf_counter()
        trainer.iterate()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(1000.0 * (time.perf_counter() - began))
    return statistics.median(times)


def _world(trainer: Trainer) -> WarpWorld:
    env: Any = trainer.collector.env
    world = env.base_env.world
    if not isinstance(world, WarpWorld):
        raise ValueError(
            f"sim.engine={world.sim.engine!r}: this benchmark measures worlds on MuJoCo Warp"
        )
    return world


@torch.no_grad()
def _env_step_ms(trainer: Trainer, device: torch.device, repeats: int) -> float:
    """Time one env step, with transforms and masked reset and without the policy, as one graph."""
    env, compiled_step = trainer.collector.env, trainer.collector.compiled_step
    root_E = env.reset()
    answered_E = trainer.collector.policy(root_E.copy()).clone()

    def step() -> None:
        (compiled_step or env.step_and_maybe_reset)(answered_E.copy())

    captured = Captured(step, device=device, warmup=2)
    for _ in range(4):
        captured()
    return milliseconds(captured, device=device, repeats=4 * repeats)


def _table(cfg: RunCfg, figures: dict[str, float], device: torch.device) -> Table:
    table = Table(title=f"{cfg.task_name}, {cfg.num_envs} envs, {report.device_name(device)}")
    for column in ("", "ms", "env states", "env states/s", "relative to physics"):
        table.add_column(column, justify="left" if not column else "right")
    dataset = num_env_states(cfg)
    physics_per_s = 1000.0 * cfg.num_envs / figures["physics_ms"]
    rows = (
        ("raw physics (MuJoCo Warp)", "physics_ms", cfg.num_envs),
        ("own substeps", "own_physics_ms", cfg.num_envs),
        ("env step", "env_step_ms", cfg.num_envs),
        ("rollout", "rollout_ms", dataset),
        ("update", "update_ms", dataset),
        ("whole iteration", "iteration_ms", dataset),
    )
    for label, key, env_states in rows:
        per_s = 1000.0 * env_states / figures[key]
        table.add_row(
            label,
            f"{figures[key]:.3f}",
            str(env_states),
            f"{per_s:,.0f}",
            f"{per_s / physics_per_s:.3f}",
        )
    return table


def main() -> None:
    """Measure, print the tables, and write the figures."""
    cfg = command_line.compose([*sys.argv[1:], "logger=none", "trainer.eval_episodes=0"])
    device = cfg.resolved_device()
    figures = measure(cfg)
    Console().print(_table(cfg, figures, device))
    beside = ("per_world", "host", "kernels")
    for name in (
        "guards_share",
        *(name for name in figures if any(word in name for word in beside)),
    ):
        print(f"{name} {figures[name]:.4g}")
    if device.type == "cpu":
        both = engines.measure(cfg)
        Console().print(engines.table(cfg, both))
        figures |= both
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    path = report.write(
        "throughput",
        figures={f"{prefix}/{name}": round(value, 6) for name, value in figures.items()},
        device=device,
        module="benchmarks.throughput",
        sizes={
            prefix: {
                "rollout_length": cfg.data.rollout_length(cfg.num_envs),
                "num_epochs": getattr(cfg.objective, "num_epochs", None),
                "num_minibatches": getattr(cfg.data, "num_minibatches", None),
            }
        },
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
