"""The time that physics cannot do without: the substeps of an env step, from states and controls of a run."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from benchmarks.stopwatch import milliseconds
from ksim_rl.collectors import RolloutCollector
from ksim_rl.envs.innermost import innermost
from ksim_rl.physics import World
from ksim_rl.physics.capture import no_collection
from ksim_rl.physics.streams import warp_scope

RECORDED_STEPS = 16


@dataclass(frozen=True, kw_only=True)
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


def physics_ms(world: World, decimation: int, steps: Sequence[RecordedStep], *, repeats: int) -> float:
    """Time the substeps of one env step alone, as one graph with all sensors in each, over the recorded steps."""
    device, warp_device = world.device, wp.get_device(str(world.device))

    def substeps() -> None:
        for _ in range(decimation):
            mjw.step(world.warp_model, world.warp_data_E)

    with warp_scope(device):
        substeps()
    _synchronize(device)
    with no_collection(), wp.ScopedDevice(warp_device), wp.ScopedCapture(device=warp_device) as capture:
        substeps()
    times = []
    for step in steps:

        def restore(step: RecordedStep = step) -> None:
            world.load_state_dict(step.state)
            world.ctrl_EL.copy_(step.ctrl_EL)
            _synchronize(device)

        times.append(
            milliseconds(
                lambda: _launch(capture.graph, device), device=device, repeats=repeats, before=restore
            )
        )
    return statistics.mean(times)


def _launch(graph: wp.Graph, device: torch.device) -> None:
    with warp_scope(device):
        wp.capture_launch(graph)


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
