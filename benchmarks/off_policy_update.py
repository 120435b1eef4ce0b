"""Times one gradient step of FastSAC, with the sizes and settings of a task that has it.

    python -m benchmarks.off_policy_update device=cuda task=g1_velocity_flat

The update is what `ksim-rl train task=... objective=fast_sac` runs; env states are random numbers, and two envs are
built, to know their sizes. `gradient_step_ms` is a whole update divided by its gradient steps: adding 4 steps
of 4096 envs to the replay, drawing minibatches, the steps of critics, actor, temperature and targets. `eager_ms` is the
same without `objective.compile`, captured in a graph as well; `kernels` counts the kernels of a gradient step. Figures
go to benchmarks/results/off_policy_update.json, as `<device>/<robot>/<figure>`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch.profiler import ProfilerActivity, profile
from torchrl.envs import EnvBase

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl import conf, envs
from ksim_rl.algorithms.off_policy.wiring import make_off_policy_update
from ksim_rl.device.streams import checked_device
from ksim_rl.trainers import RunCfg

WARMUP, REPEATS = 4, 20


def main() -> None:
    """Time the update with and without the compiler, print the figures, and write them."""
    defaults = {
        "device": "cuda" if torch.cuda.is_available() else "cpu",
        "task": "g1_velocity_flat",
    }
    given = command_line.options(sys.argv[1:], defaults)
    device, task = checked_device(given["device"]), given["task"]
    cfg: Any = conf.compose([f"task={task}", "objective=fast_sac", f"device={device.type}"])
    cfg = replace(cfg, data=replace(cfg.data, capacity=64))
    env = envs.make(task, num_envs=2, seed=0, device=device)
    torch.set_float32_matmul_precision("high")
    label = f"{report.device_label(device)}/{task.split('_')[0]}"
    figures = {f"{label}/{name}": value for name, value in compare(cfg, env, device=device).items()}
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    path = report.write(
        "off_policy_update", figures=figures, device=device, module="benchmarks.off_policy_update"
    )
    print(f"written to {path}")


def compare(
    cfg: RunCfg, env: EnvBase, *, device: torch.device, repeats: int = REPEATS
) -> dict[str, float]:
    """Return milliseconds and kernels of a gradient step, with the compiler and without."""
    figures, objective = {}, cfg.objective
    for compiled, time, kernels in (
        (True, "gradient_step_ms", "kernels"),
        (False, "eager_ms", "eager_kernels"),
    ):
        torch.manual_seed(0)
        update = make_off_policy_update(
            replace(cfg, objective=replace(objective, compile=compiled)), env
        )
        rollout_ET = make_rollout(cfg, env, device=device)
        steps = update.data.num_minibatches
        for _ in range(WARMUP):
            update(rollout_ET)
        figures[time] = (
            milliseconds(partial(update, rollout_ET), repeats=repeats, device=device) / steps
        )
        if device.type == "cuda":
            with profile(activities=[ProfilerActivity.CUDA]) as recorded:
                update(rollout_ET)
                torch.cuda.synchronize()
            figures[kernels] = round(
                sum(event.count for event in recorded.key_averages()) / steps, 1
            )
    return figures


def make_rollout(cfg: Any, env: EnvBase, *, device: torch.device) -> TensorDict:
    """Return random env states `["E","T"]` of the env's sizes; 2 percent of them end an episode."""
    shape = (cfg.num_envs, cfg.data.num_steps)
    spec: Any = env.observation_spec

    def draw(size: int) -> torch.Tensor:
        return torch.randn(*shape, size, device=device)

    def observed() -> dict[str, Any]:
        return {group: draw(spec[group].shape[-1]) for group in ("actor", "critic")}

    done = draw(1) > 2.0
    following = {**observed(), "reward": draw(1), "done": done, "terminated": done.clone()}
    action = draw(env.action_spec.shape[-1]).clamp(-1.0, 1.0)
    leaves = {**observed(), "action": action, "next": following}
    return TensorDict(leaves, batch_size=shape, device=device)


if __name__ == "__main__":
    command_line.run(main)
