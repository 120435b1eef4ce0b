"""Times the kernels of smooth dynamics and of integration beside the same stages of MuJoCo Warp.

    python -m benchmarks.smooth_dynamics task=go1_velocity_flat num_envs=4096 device=cuda lanes=4,8,16,32

takes states of the task under random actions, times those stages from there (kinematics to the sum of forces, in one
graph) by MuJoCo Warp's kernels and by ours with each number of threads per world, checks that both agree and that the
number of threads changes no bit, does the same for the integration, and times the substeps of one env step with either.
Figures go to benchmarks/results/smooth_dynamics.json.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from functools import partial

import mujoco_warp as mjw
import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl import envs
from ksim_rl.device.streams import checked_device
from ksim_rl.physics.smooth.stages import integration, smooth_dynamics
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.transforms.innermost import innermost

RANDOM_STEPS = 20
TIMES_IN_A_GRAPH = 20
REPEATS = 20
STATE = ("qpos", "qvel", "act", "time")
COMPARED = ("M", "qfrc_bias", "qfrc_smooth", "geom_xpos", "cvel", "cdof_dot", "cinert", "site_xmat")
LARGEST_ERROR = 1e-5


@torch.no_grad()
def main() -> None:
    """Measure, print the table, and write the figures."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    defaults = {
        "task": "go1_velocity_flat",
        "num_envs": "4096",
        "device": device,
        "lanes": "4,8,16,32",
    }
    given = command_line.options(sys.argv[1:], defaults)
    num_envs = command_line.whole_number("num_envs", given["num_envs"])
    lanes = command_line.whole_numbers("lanes", given["lanes"])
    device = checked_device(given["device"])
    decimation = envs.make_cfg(given["task"]).decimation
    env = envs.make(given["task"], num_envs=num_envs, device=device, seed=0)
    env.rollout(RANDOM_STEPS, break_when_any_done=False)
    world = innermost(env).world
    figures = (
        stages_ms(world, lanes) | integration_ms(world, lanes) | substeps_ms(world, decimation)
    )
    table = Table(title=f"{given['task']}, {num_envs} envs, {report.device_name(device)}")
    for column in ("", "ms"):
        table.add_column(column, justify="left" if not column else "right")
    for name, value in figures.items():
        table.add_row(name, f"{value:.4f}")
    Console().print(table)
    label = f"{report.device_label(device)}/{given['task']}/{num_envs}"
    path = report.write(
        "smooth_dynamics",
        figures={f"{label}/{name}": round(value, 6) for name, value in figures.items()},
        device=device,
        module="benchmarks.smooth_dynamics",
    )
    print(f"written to {path}")


def stages_ms(world: WarpWorld, lanes: list[int]) -> dict[str, float]:
    """Return the time of the stages by MuJoCo Warp's kernels and by ours, ms; a RuntimeError where they differ."""
    opt = dataclasses.replace(world.warp_model.opt, run_qacc_smooth=False)
    m, d = dataclasses.replace(world.warp_model, opt=opt), world.warp_data_E

    def theirs() -> None:
        mjw.kinematics(m, d)
        mjw.com_pos(m, d)
        mjw.crb(m, d)
        mjw.transmission(m, d)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d, factorize=True)

    ways: dict[str, Callable[[], None]] = {"mujoco_warp_stages_ms": theirs}
    for number in lanes:
        ways[f"one_kernel_{number}_lanes_ms"] = smooth_dynamics(m, d, lanes=number)
    found, results = {}, []
    for name, way in ways.items():
        found[name] = _stages_ms(world, name, way)
        results.append({field: world.last_substep(field).clone() for field in COMPARED})
    check(results)
    return found


def integration_ms(world: WarpWorld, lanes: list[int]) -> dict[str, float]:
    """Return the time of an integration by MuJoCo Warp's kernels and by ours, ms; a RuntimeError where they differ."""
    if world.one_kernel_integration_unavailable is not None:
        return {}
    m, d = world.warp_model, world.warp_data_E
    theirs = mjw.euler if m.opt.integrator == mjw.IntegratorType.EULER else mjw.implicit
    ways: dict[str, Callable[[], None]] = {"mujoco_warp_integration_ms": partial(theirs, m, d)}
    for number in lanes:
        ways[f"one_kernel_integration_{number}_lanes_ms"] = integration(m, d, lanes=number)
    world.step(1)
    before = {field: world.last_substep(field).clone() for field in STATE}
    found, results = {}, []
    for name, way in ways.items():
        # Once, then as often as it takes to time it, which leads to no state that a world would reach.
        for once in (True, False):
            for field, rows in before.items():
                world.last_substep(field).copy_(rows)
            if once:
                world.launch(f"{name} once", way)
                results.append({field: world.last_substep(field).clone() for field in STATE})
            else:
                found[name] = _stages_ms(world, name, way)
    for field, rows in before.items():
        world.last_substep(field).copy_(rows)
    check(results)
    return found


def check(results: list[dict[str, torch.Tensor]]) -> None:
    """Raise a RuntimeError where later results differ among themselves, or from the first by more than rounding."""
    for field in results[0]:
        expected, *ours = (result[field] for result in results)
        if not expected.numel():
            continue
        scale = 1.0 + expected.abs().max()
        if any(not torch.equal(other, ours[0]) for other in ours):
            raise RuntimeError(f"{field}: the number of lanes changes bits")
        error = ((ours[0] - expected) / scale).abs().max().item()
        if not error <= LARGEST_ERROR:
            raise RuntimeError(
                f"{field}: {error:.1e} of the largest from MuJoCo Warp's, at most {LARGEST_ERROR}"
            )


def _stages_ms(world: WarpWorld, name: str, way: Callable[[], None]) -> float:
    def often() -> None:
        for _ in range(TIMES_IN_A_GRAPH):
            way()

    for _ in range(3):
        world.launch(name, often)
    took = milliseconds(lambda: world.launch(name, often), device=world.device, repeats=REPEATS)
    return took / TIMES_IN_A_GRAPH


def substeps_ms(world: WarpWorld, decimation: int) -> dict[str, float]:
    """Return the time of one env step's substeps from the present state, with either way of the smooth dynamics, ms."""
    state, ctrl_EL = world.state_dict(), world.ctrl_EL.clone()
    found = {}
    for one_kernel_dynamics in (False, True):
        sim = dataclasses.replace(
            world.sim,
            one_kernel_dynamics=one_kernel_dynamics,
            nan_guard=None,
            njmax=world.njmax,
            nconmax=world.nconmax,
        )
        own = WarpWorld(
            world.mj_model,
            num_envs=world.num_envs,
            device=world.device,
            sim=sim,
            per_world_fields=tuple(world.per_world_fields()),
        )

        def restore(own: WarpWorld = own) -> None:
            own.load_state_dict(state)
            own.ctrl_EL.copy_(ctrl_EL)

        for _ in range(3):
            own.step(decimation)
        name = (
            "substeps_with_one_kernel_ms" if one_kernel_dynamics else "substeps_with_mujoco_warp_ms"
        )
        step = lambda own=own: own.step(decimation)  # noqa: E731
        found[name] = milliseconds(step, device=world.device, repeats=REPEATS, before=restore)
        own.close()
    return found


if __name__ == "__main__":
    command_line.run(main)
