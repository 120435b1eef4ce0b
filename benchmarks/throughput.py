"""How fast training is, beside the physics that it cannot do without.

    python -m benchmarks.throughput task=go1_velocity_flat num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`, trains some iterations, and prints one table: raw physics (the decimation's
`mjw.step` calls as one graph, sensors in each, from states and controls recorded in this run), the env step, the
rollout, the PPO update and the whole iteration, each in env states/s and relative to raw physics. Figures go to
benchmarks/results/throughput.json.
"""

from __future__ import annotations

import statistics
import sys
import time
from dataclasses import dataclass
from typing import Any

import mujoco_warp as mjw
import torch
import warp as wp
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks import report
from benchmarks.stopwatch import milliseconds
from ksim_rl import conf
from ksim_rl.physics import World
from ksim_rl.physics.capture import Captured
from ksim_rl.physics.streams import warp_scope
from ksim_rl.trainers import RunCfg, Trainer, build

RECORDED_STEPS = 16


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


@dataclass(frozen=True, kw_only=True)
class RecordedStep:
    """One env step of a run: the physics state before it, and the controls that it applied."""

    state: dict[str, Tensor]
    ctrl_EL: Tensor


def measure(cfg: RunCfg) -> dict[str, float]:
    """Train some iterations of `cfg` and return the figures, ms and env states/s."""
    trainer = build(cfg)
    device = _world(trainer).device
    schedule = SCHEDULES[device.type]
    collector, update = trainer.collector, trainer.update
    for _ in range(schedule.warmup_iterations):
        update(collector.collect())

    iteration_ms = _iteration_ms(trainer, device, schedule.timed_iterations)
    rollout_ms = milliseconds(collector.collect, device=device, repeats=schedule.repeats)
    rollout_ET = collector.collect()
    update_ms = milliseconds(lambda: update(rollout_ET), device=device, repeats=schedule.repeats)
    steps = _record_steps(trainer)
    env_step_ms = _env_step_ms(trainer, device, schedule.repeats)
    physics_ms = _physics_ms(trainer, steps, device, schedule.repeats)

    env_states_per_s = 1000.0 * cfg.data.num_env_states / iteration_ms
    return {
        "physics_ms": physics_ms,
        "env_step_ms": env_step_ms,
        "rollout_ms": rollout_ms,
        "update_ms": update_ms,
        "iteration_ms": iteration_ms,
        "env_states_per_s": env_states_per_s,
        "iteration_over_physics": env_states_per_s / (1000.0 * cfg.num_envs / physics_ms),
    }


def _iteration_ms(trainer: Trainer, device: torch.device, iterations: int) -> float:
    """Time whole iterations as `Trainer.train` runs them, logging included, on the wall clock."""
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


def _world(trainer: Trainer) -> World:
    env: Any = trainer.collector.env
    return env.base_env.world


@torch.no_grad()
def _record_steps(trainer: Trainer) -> list[RecordedStep]:
    """Run the policy on, and record what each step's physics starts from."""
    env, policy, world = trainer.collector.env, trainer.collector.policy, _world(trainer)
    root_E, steps = env.reset(), []
    # Episodes have to be under way: just reset robots stand still, or fall.
    for index in range(2 * RECORDED_STEPS):
        state = world.state_dict()
        _, root_E = env.step_and_maybe_reset(policy(root_E))
        if index >= RECORDED_STEPS:
            steps.append(RecordedStep(state=state, ctrl_EL=world.ctrl_EL.clone()))
    return steps


@torch.no_grad()
def _env_step_ms(trainer: Trainer, device: torch.device, repeats: int) -> float:
    """Time one env step, with transforms and masked reset and without the policy, as one graph."""
    env = trainer.collector.env
    root_E = env.reset()
    action_EL = trainer.collector.policy(root_E.copy())["action"].clone()

    def step() -> None:
        env.step_and_maybe_reset(root_E.copy().set("action", action_EL))

    captured = Captured(step, device=device, warmup=2)
    for _ in range(4):
        captured()
    return milliseconds(captured, device=device, repeats=4 * repeats)


def _physics_ms(trainer: Trainer, steps: list[RecordedStep], device: torch.device, repeats: int) -> float:
    """Time the substeps of one env step alone, all sensors in each, over the recorded steps."""
    world = _world(trainer)
    decimation: int = trainer.collector.env.base_env.cfg.decimation  # pyright: ignore
    warp_device = wp.get_device(str(device))

    def substeps() -> None:
        for _ in range(decimation):
            mjw.step(world.warp_model, world.warp_data_E)

    with warp_scope(device):
        substeps()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    with wp.ScopedDevice(warp_device), wp.ScopedCapture(device=warp_device) as capture:
        substeps()
    times = []
    for step in steps:

        def restore(step: RecordedStep = step) -> None:
            world.load_state_dict(step.state)
            world.ctrl_EL.copy_(step.ctrl_EL)
            if device.type == "cuda":
                torch.cuda.synchronize(device)

        times.append(
            milliseconds(
                lambda: _launch(capture.graph, device),
                device=device,
                repeats=max(1, repeats // 3),
                before=restore,
            )
        )
    return statistics.mean(times)


def _launch(graph: wp.Graph, device: torch.device) -> None:
    with warp_scope(device):
        wp.capture_launch(graph)


def _table(cfg: RunCfg, figures: dict[str, float], device: torch.device) -> Table:
    table = Table(title=f"{cfg.task_name}, {cfg.num_envs} envs, {report.device_name(device)}")
    for column in ("", "ms", "env states", "env states/s", "relative to physics"):
        table.add_column(column, justify="left" if not column else "right")
    dataset = cfg.data.num_env_states
    physics_per_s = 1000.0 * cfg.num_envs / figures["physics_ms"]
    rows = (
        ("raw physics", "physics_ms", cfg.num_envs),
        ("env step", "env_step_ms", cfg.num_envs),
        ("rollout", "rollout_ms", dataset),
        ("PPO update", "update_ms", dataset),
        ("whole iteration", "iteration_ms", dataset),
    )
    for label, key, env_states in rows:
        per_s = 1000.0 * env_states / figures[key]
        table.add_row(
            label, f"{figures[key]:.3f}", str(env_states), f"{per_s:,.0f}", f"{per_s / physics_per_s:.3f}"
        )
    return table


def main() -> None:
    """Measure, print the table, and write the figures."""
    cfg = conf.compose([*sys.argv[1:], "logger=none", "trainer.eval_episodes=0"])
    device = cfg.resolved_device()
    figures = measure(cfg)
    Console().print(_table(cfg, figures, device))
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    path = report.write(
        "throughput",
        figures={f"{prefix}/{name}": round(value, 6) for name, value in figures.items()},
        device=device,
        module="benchmarks.throughput",
        sizes={
            prefix: {
                "rollout_length": cfg.data.rollout_length(cfg.num_envs),
                "num_epochs": cfg.objective.num_epochs,
                "num_minibatches": cfg.data.num_minibatches,
            }
        },
    )
    print(f"written to {path}")


if __name__ == "__main__":
    main()
