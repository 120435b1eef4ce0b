"""Times the control step without domain randomization, with it at startup, and with it at each reset.

    python -m benchmarks.randomization task=go1_velocity_flat num_envs=4096 device=cuda episode_steps=100

takes the overrides of `ksim-rl train`. Each variant is the task's captured env step, transforms and masked reset
included, where every row resets once in `episode_steps` steps. The randomized ones draw mass and centre of mass of
every body, from ranges of no width: that is the same work, and the physics, whose cost depends on where the robots
are, stays the same. Beside the whole step, the reset events are timed alone, and `set_const` of all rows, which is
what a reset would cost without a mask. Figures go to benchmarks/results/randomization.json.
"""

from __future__ import annotations

import dataclasses
import re
import statistics
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl import envs, mdp
from ksim_rl.device.capture import Captured
from ksim_rl.envs import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import EventTerm
from ksim_rl.mdp.randomization.randomize import Randomize
from ksim_rl.physics import load_model
from ksim_rl.scene.scene import scene_spec
from ksim_rl.trainers import RunCfg

VARIANTS = ("none", "startup", "reset")
EPISODE_STEPS = "100"
FIELDS = ("body_mass", "body_inertia", "body_ipos")
# Small random targets keep the robots moving.
ACTION_SIZE = 0.3


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How much is run before and while measuring."""

    warmup_steps: int
    rounds: int
    steps_per_round: int


SCHEDULES = {
    "cuda": Schedule(warmup_steps=100, rounds=15, steps_per_round=20),
    "cpu": Schedule(warmup_steps=4, rounds=3, steps_per_round=4),
}


def measure(cfg: RunCfg, episode_steps: int) -> dict[str, float]:
    """Build the three variants of a task and return their figures, ms and shares of the control step."""
    device = cfg.resolved_device()
    schedule = SCHEDULES[device.type]
    bodies, step_dt = _bodies_and_step(cfg.task)
    built = {
        name: _build(cfg.task, _inertial_events(bodies, name), episode_steps * step_dt, device)
        for name in VARIANTS
    }
    step_ms = _step_ms(
        {name: _captured_step(env, device) for name, env in built.items()}, device, schedule
    )
    events_ms = {
        name: _reset_events_ms(env, episode_steps, device, schedule) for name, env in built.items()
    }
    all_rows_ms = _all_rows_ms(built["reset"], device, schedule)
    alone_ms = events_ms["reset"] - events_ms["startup"]
    return {
        "control_step_ms": step_ms["none"],
        "control_step_startup_ms": step_ms["startup"],
        "control_step_reset_ms": step_ms["reset"],
        "startup_share": step_ms["startup"] / step_ms["none"] - 1.0,
        "reset_share": step_ms["reset"] / step_ms["none"] - 1.0,
        "reset_events_ms": alone_ms,
        "reset_events_share": alone_ms / step_ms["none"],
        "set_const_of_all_rows_ms": all_rows_ms,
        "set_const_of_all_rows_share": all_rows_ms / step_ms["none"],
    }


def _bodies_and_step(task: ManagerBasedRlEnvCfg) -> tuple[tuple[str, ...], float]:
    """Return patterns of the bodies that have a mass, and the seconds of an env step."""
    model = load_model(scene_spec(task.scene, task.sim))
    heavy = [
        model.body(i).name
        for i in range(model.nbody)
        if model.body_mass[i] > 0.0 and model.body(i).name
    ]
    return tuple(re.escape(name) for name in heavy), model.opt.timestep * task.decimation


def _inertial_events(bodies: tuple[str, ...], variant: str) -> dict[str, EventTerm]:
    if variant == "none":
        return {}
    mode = "startup" if variant == "startup" else "reset"
    mass = mdp.RandomizeBodyMass(bodies=bodies, ranges=(1.0, 1.0), mode=mode)
    com = mdp.RandomizeBodyCom(bodies=bodies, ranges=(0.0, 0.0), operation="add", mode=mode)
    return {"benchmark_mass": mass, "benchmark_com": com}


def _build(
    task: ManagerBasedRlEnvCfg,
    events: Mapping[str, EventTerm],
    episode_length_s: float,
    device: torch.device,
) -> Any:
    """Build the task without randomization of its own, with `events`, and with episodes that end by time alone."""
    own = {
        name: term for name, term in (task.events or {}).items() if not isinstance(term, Randomize)
    }
    env: Any = envs.build(
        dataclasses.replace(
            task,
            events={**own, **events},
            terminations={"time_out": mdp.TimeOut(time_out=True)},
            episode_length_s=episode_length_s,
        ),
        device=device,
    )
    env.reset()
    env.base_env.stagger_episodes_()
    return env


def _captured_step(env: Any, device: torch.device) -> Captured:
    generator = torch.Generator(device).manual_seed(0)
    root_E = env.reset()
    env.base_env.stagger_episodes_()
    action_EL = ACTION_SIZE * torch.randn(env.action_spec.shape, generator=generator, device=device)

    def step() -> None:
        with torch.no_grad():
            env.step_and_maybe_reset(root_E.copy().set("action", action_EL))

    return Captured(step, device=device, warmup=2)


def _step_ms(
    steps: Mapping[str, Captured], device: torch.device, schedule: Schedule
) -> dict[str, float]:
    """Time the steps in turns, so that a drift of the device's clocks reaches all of them alike."""
    for step in steps.values():
        _repeat(step, schedule.warmup_steps)
    rounds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(schedule.rounds):
        for name, step in steps.items():
            rounds[name].append(_each_ms(step, device, schedule))
    return {name: statistics.median(times) for name, times in rounds.items()}


def _reset_events_ms(
    env: Any, episode_steps: int, device: torch.device, schedule: Schedule
) -> float:
    """Time the reset events alone, for as many rows as reset in a step."""
    base_env = env.base_env
    rows = torch.arange(base_env.num_envs, device=device)
    mask_E = rows % episode_steps == 0

    def reset_events() -> None:
        base_env.event_manager.reset(mask_E)
        base_env.driver.refreshed()

    return _warm_ms(reset_events, device, schedule)


def _all_rows_ms(env: Any, device: torch.device, schedule: Schedule) -> float:
    """Time what recomputes the constants of all rows."""
    return _warm_ms(lambda: env.base_env.world.set_const(FIELDS), device, schedule)


def _warm_ms(work: Callable[[], None], device: torch.device, schedule: Schedule) -> float:
    captured = Captured(work, device=device, warmup=2)
    _repeat(captured, 4)
    return statistics.median(_each_ms(captured, device, schedule) for _ in range(schedule.rounds))


def _each_ms(work: Callable[[], None], device: torch.device, schedule: Schedule) -> float:
    count = schedule.steps_per_round
    return milliseconds(lambda: _repeat(work, count), device=device, repeats=1) / count


def _repeat(work: Callable[[], None], count: int) -> None:
    for _ in range(count):
        work()


def _table(
    cfg: RunCfg, figures: Mapping[str, float], episode_steps: int, device: torch.device
) -> Table:
    title = f"{cfg.task_name}, {cfg.num_envs} envs, a reset every {episode_steps} steps, {report.device_name(device)}"
    table = Table(title=title)
    for column in ("", "ms", "share of the control step"):
        table.add_column(column, justify="left" if not column else "right")
    table.add_row("control step, no randomization", f"{figures['control_step_ms']:.3f}", "")
    for label, time, share in (
        ("mass and com at startup", "control_step_startup_ms", "startup_share"),
        ("mass and com at each reset", "control_step_reset_ms", "reset_share"),
        ("reset events of mass and com alone", "reset_events_ms", "reset_events_share"),
        ("set_const of all rows alone", "set_const_of_all_rows_ms", "set_const_of_all_rows_share"),
    ):
        table.add_row(label, f"{figures[time]:.3f}", f"{100.0 * figures[share]:+.2f} %")
    return table


def main() -> None:
    """Measure, print the table, and write the figures."""
    own, overrides = command_line.split(sys.argv[1:], {"episode_steps": EPISODE_STEPS})
    episode_steps = command_line.whole_number("episode_steps", own["episode_steps"])
    cfg = command_line.compose([*overrides, "logger=none", "trainer.eval_episodes=0"])
    device = cfg.resolved_device()
    figures = measure(cfg, episode_steps)
    Console().print(_table(cfg, figures, episode_steps, device))
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    path = report.write(
        "randomization",
        figures={f"{prefix}/{name}": round(value, 6) for name, value in figures.items()},
        device=device,
        module="benchmarks.randomization",
        sizes={prefix: {"episode_steps": episode_steps}},
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
