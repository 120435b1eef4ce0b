"""The floor: what MuJoCo Warp itself takes for the substeps of an env step, from states and controls of a run.

It is `mjw.step` on a model as `mjw.put_model` gives it, with its own choice of Jacobian and its own solver, and with
the same fields per world. Of what this project changes about physics it has only what all its worlds share and what
makes this floor faster: capacities that fit, no conditional node around few solver iterations, and the contacts that
follow the C engine (`ksim_rl/physics/contacts.py`).
"""

from __future__ import annotations

import copy
import dataclasses
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from benchmarks.stopwatch import milliseconds
from ksim_rl.collectors import RolloutCollector
from ksim_rl.device.capture import no_collection
from ksim_rl.device.streams import warp_scope
from ksim_rl.physics.warp_world import WarpWorld
from ksim_rl.transforms.innermost import innermost

RECORDED_STEPS = 16


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordedStep:
    """One env step of a run: the physics state before it, and the controls that it applied."""

    state: dict[str, Tensor]
    ctrl_EL: Tensor


@torch.no_grad()
def record_steps(collector: RolloutCollector, count: int = RECORDED_STEPS) -> list[RecordedStep]:
    """Go on from where the collector's last rollout ended, and record what each step's physics starts from."""
    env: Any = collector.env
    world, root_E, steps = innermost(env).world, env.last_root.clone(), []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(count):
            state = world.state_dict()
            _, root_E = env.step_and_maybe_reset(collector.policy(root_E))
            steps.append(RecordedStep(state=state, ctrl_EL=world.ctrl_EL.clone()))
    return steps


def stock_world(world: WarpWorld) -> WarpWorld:
    """Return worlds of the same model and fields on which `mjw.step` is MuJoCo Warp's own from end to end."""
    model = copy.copy(world.mj_model)
    if world.has_one_kernel_solver:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    return WarpWorld(
        model,
        num_envs=world.num_envs,
        device=world.device,
        sim=dataclasses.replace(
            world.sim,
            one_kernel_solver=False,
            nan_guard=None,
            njmax=world.njmax,
            nconmax=world.nconmax,
        ),
        per_world_fields=tuple(world.per_world_fields()),
    )


def physics_ms(
    world: WarpWorld, decimation: int, steps: Sequence[RecordedStep], *, repeats: int
) -> float:
    """Time MuJoCo Warp's substeps of one env step, as one graph with all sensors in each, over the recorded steps."""
    stock = stock_world(world)

    def substeps() -> None:
        for _ in range(decimation):
            mjw.step(stock.warp_model, stock.warp_data_E)

    found = _mean_ms(stock, as_graph(substeps, stock.device), steps, repeats=repeats)
    stock.close()
    return found


def as_graph(launches: Callable[[], object], device: torch.device) -> Callable[[], None]:
    """Return a replay of some launches of Warp, which have run twice, as one graph."""
    warp_device = wp.get_device(str(device))
    with warp_scope(device):
        launches()
    _synchronize(device)
    with (
        no_collection(),
        wp.ScopedDevice(warp_device),
        wp.ScopedCapture(device=warp_device) as capture,
    ):
        launches()

    def replay() -> None:
        _launch(capture.graph, device)

    replay()
    return replay


def own_physics_ms(
    world: WarpWorld, decimation: int, steps: Sequence[RecordedStep], *, repeats: int
) -> float:
    """Time this project's substeps of one env step, over the recorded steps."""
    for _ in range(2):
        world.step(decimation)
    return _mean_ms(world, lambda: world.step(decimation), steps, repeats=repeats)


def _mean_ms(
    world: WarpWorld, substeps: Callable[[], object], steps: Sequence[RecordedStep], *, repeats: int
) -> float:
    times = []
    for step in steps:

        def restore(step: RecordedStep = step) -> None:
            world.load_state_dict(step.state)
            world.ctrl_EL.copy_(step.ctrl_EL)
            _synchronize(world.device)

        times.append(milliseconds(substeps, device=world.device, repeats=repeats, before=restore))
    return statistics.mean(times)


def _launch(graph: wp.Graph, device: torch.device) -> None:
    with warp_scope(device):
        wp.capture_launch(graph)


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
