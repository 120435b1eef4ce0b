"""Times the raw physics of a robot on each kind of rough ground, beside the same robot on a plane.

    python -m benchmarks.terrain task=go1_velocity_rough num_envs=4096 device=cuda variants=default,fine

builds the task's robot and physics settings on a plane, and on each kind of the task's terrain by itself, with the
robots spread over all of the patch and over all levels. They hold their default pose with random targets around it,
which keeps most on their feet, and the time of one env step's substeps (one graph) is taken as they go. Terminations
are off: who falls stays there, on the plane too. Figures go to benchmarks/results/terrain.json; `rough_over_flat` is
the mean time over the kinds, relative to the plane.

Variants: "default" as in the task; "fine" and "coarse" with cells of half and of twice the width.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
from collections.abc import Mapping

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl import envs
from ksim_rl.checks import unknown_name
from ksim_rl.device.streams import checked_device
from ksim_rl.envs.driver import EnvDriver
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.view import EnvView
from ksim_rl.physics import World, load_model
from ksim_rl.scene.scene import scene_spec
from ksim_rl.scene.terrains import (
    Ground,
    PlaneTerrain,
    Terrain,
    TerrainGrid,
)

TASK = "go1_velocity_rough"
"""Its `rough_over_flat` on a GPU stands in the results by that name alone."""
VARIANTS = {"default": 1.0, "fine": 0.5, "coarse": 2.0}
"""Width of the cells, relative to the task's."""
SETTLE_STEPS = {"cuda": 50, "cpu": 10}
TIMED_STEPS = {"cuda": 50, "cpu": 5}
SPREAD = 0.4
"""Robots start within this share of the patch's edge from its centre."""
TARGET_STD = 0.1
"""rad of the random targets about the default pose."""
FOOTPRINT = 0.35
"""m around a robot's root: within it no start may lie inside the ground."""


def main() -> None:
    """Measure, print the table, and write the figures."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    defaults = {"task": TASK, "num_envs": "4096", "device": device, "variants": "default"}
    given = command_line.options(sys.argv[1:], defaults)
    num_envs = command_line.whole_number("num_envs", given["num_envs"])
    for variant in given["variants"].split(","):
        if variant not in VARIANTS:
            raise unknown_name("variant", variant, VARIANTS)
    cfg = envs.make_cfg(given["task"], [f"task.scene.num_envs={num_envs}"])
    device = checked_device(given["device"])
    prefix = f"{report.device_label(device)}/{given['task']}/{num_envs}"
    figures: dict[str, float] = {}
    for variant in given["variants"].split(","):
        milliseconds_by_kind = measure(cfg, device, VARIANTS[variant])
        ratios = summary(milliseconds_by_kind)
        Console().print(_table(variant, milliseconds_by_kind, device))
        label = prefix if variant == "default" else f"{prefix}/{variant}"
        figures |= {f"{label}/{kind}_ms": value for kind, value in milliseconds_by_kind.items()}
        figures |= {f"{label}/{name}": value for name, value in ratios.items()}
        if variant == "default" and device.type == "cuda" and given["task"] == TASK:
            figures["rough_over_flat"] = ratios["rough_over_flat"]
    path = report.write(
        "terrain",
        figures={name: round(value, 6) for name, value in figures.items()},
        device=device,
        module="benchmarks.terrain",
    )
    print(f"written to {path}")


def measure(cfg: ManagerBasedRlEnvCfg, device: torch.device, cell_scale: float) -> dict[str, float]:
    """Return the time of one env step's physics on the plane, on each kind of ground, and on all of them, ms."""
    terrain = cfg.scene.terrain
    if not isinstance(terrain, TerrainGrid):
        raise ValueError(f"task: its terrain is {terrain!r}: choose a task on a TerrainGrid")
    patches = {
        name: dataclasses.replace(patch, cell=patch.cell * cell_scale)
        for name, patch in terrain.patches.items()
    }
    everywhere = dataclasses.replace(
        terrain, patches=patches, max_initial_level=terrain.num_levels - 1
    )
    grounds: dict[str, Terrain] = {"plane": PlaneTerrain(friction=terrain.friction)}
    for name, patch in patches.items():
        grounds[name] = dataclasses.replace(everywhere, patches={name: patch}, num_columns=1)
    grounds["mixed"] = everywhere
    return {name: _physics_ms(cfg, ground, device) for name, ground in grounds.items()}


def summary(milliseconds_by_kind: Mapping[str, float]) -> dict[str, float]:
    """Return `rough_over_flat`, the mean over the kinds, and `mixed_over_flat`, with all kinds in one batch."""
    plane = milliseconds_by_kind["plane"]
    kinds = [
        value for name, value in milliseconds_by_kind.items() if name not in ("plane", "mixed")
    ]
    return {
        "rough_over_flat": statistics.mean(kinds) / plane,
        "mixed_over_flat": milliseconds_by_kind["mixed"] / plane,
    }


@torch.no_grad()
def _physics_ms(cfg: ManagerBasedRlEnvCfg, terrain: Terrain, device: torch.device) -> float:
    scene = dataclasses.replace(cfg.scene, terrain=terrain)
    world = World(
        load_model(scene_spec(scene, cfg.sim)),
        num_envs=scene.num_envs,
        device=device,
        sim=cfg.sim,
        per_world_fields=terrain.per_world_fields,
    )
    view = EnvDriver(
        world, step_dt=cfg.decimation * world.timestep, entities=tuple(scene.entities)
    ).view
    generator = torch.Generator(device).manual_seed(0)
    _spread(view, terrain.ground(view), generator)
    pose_K = _default_targets(view)

    def new_targets() -> None:
        noise_EK = torch.randn(world.ctrl_EL.shape, generator=generator, device=device)
        world.ctrl_EL.copy_(pose_K + TARGET_STD * noise_EK)

    for _ in range(SETTLE_STEPS[device.type]):
        new_targets()
        world.step(cfg.decimation)
    elapsed = milliseconds(
        lambda: world.step(cfg.decimation),
        device=device,
        repeats=TIMED_STEPS[device.type],
        before=new_targets,
    )
    _refuse_overflow(world)
    world.close()
    return elapsed


def _spread(view: EnvView, ground: Ground, generator: torch.Generator) -> None:
    """Put the robots, in their default pose, at random places of their patches."""
    qpos_EL = view.default_qpos_L.expand(view.num_envs, -1).clone()
    reach = 0.0 if ground.is_flat else 2 * SPREAD * ground.half_width
    place_E2 = torch.rand(view.num_envs, 2, generator=generator, device=view.device)
    qpos_EL[:, :2] += reach * (2 * place_E2 - 1)
    steps = torch.linspace(-FOOTPRINT, FOOTPRINT, 5, device=view.device)
    around_N2 = torch.cartesian_prod(steps, steps)
    qpos_EL[:, 2] += ground.heights(qpos_EL[:, None, :2] + around_N2).amax(-1)
    view.world.qpos_EL.copy_(qpos_EL)
    view.world.refresh()


def _default_targets(view: EnvView) -> torch.Tensor:
    """Return the default position of the joint that each actuator drives, [K]."""
    model = view.world.mj_model
    addresses = [int(model.jnt_qposadr[joint]) for joint in model.actuator_trnid[:, 0]]
    return view.default_qpos_L[addresses]


def _refuse_overflow(world: World) -> None:
    """Raise if contacts or constraints were dropped: such a time would be too short."""
    report = world.overflow_report()
    if report.messages:
        raise RuntimeError(f"the physics dropped work: {'; '.join(report.messages)}")


def _table(variant: str, milliseconds_by_kind: Mapping[str, float], device: torch.device) -> Table:
    table = Table(title=f"physics of one env step, {variant} cells, {report.device_name(device)}")
    for column in ("ground", "ms", "relative to the plane"):
        table.add_column(column, justify="left" if column == "ground" else "right")
    for name, value in milliseconds_by_kind.items():
        table.add_row(name, f"{value:.3f}", f"{value / milliseconds_by_kind['plane']:.2f}")
    for name, value in summary(milliseconds_by_kind).items():
        table.add_row(name, "", f"{value:.2f}")
    return table


if __name__ == "__main__":
    command_line.run(main)
