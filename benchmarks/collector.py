"""Times the captured rollout beside TorchRL's own `Collector` on the same env.

    python -m benchmarks.collector task=cartpole_balance num_envs=4096,64 device=cuda

takes the overrides of `ksim-rl train`; `num_envs` may be a list. Both sides step the same kind of env with the same
policy for `steps` (default 32) steps per rollout, in turn; each figure is the median over the rounds of the ratio of
their times, so that whatever else the machine does weighs on both. `compiled_over_captured` is what
`collector.compile=true` makes of it. The stock side steps its env with eager physics
(`captured_over_stock`), and once more with each control step's physics as one graph
(`captured_over_stock_with_graphs`). Figures go to benchmarks/results/collector.json as
`<device>/cartpole/<num_envs>/...`.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torchrl.collectors import Collector

from benchmarks import command_line, report
from benchmarks.stopwatch import milliseconds
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.device.capture import live_launches
from ksim_rl.trainers import RunCfg
from ksim_rl.trainers.algorithm import make_update
from ksim_rl.trainers.build import build_env

ROUNDS = 7
WARMUP = 3
STEPS = 32


def measure(cfg: RunCfg, *, steps: int = STEPS, rounds: int = ROUNDS) -> dict[str, float]:
    """Return env states/s of each side, medians over the rounds, and the ratios."""
    device = cfg.resolved_device()
    torch.manual_seed(cfg.seed)
    envs = [build_env(cfg, num_envs=cfg.num_envs, seed=cfg.seed) for _ in range(3)]
    actor = make_update(cfg, envs[0]).behavior
    ours, compiled = (
        RolloutCollector(env, actor, rollout_length=steps, cfg=CollectorCfg(compile=compile))
        for env, compile in zip(envs[::2], (False, True), strict=True)
    )
    stock = iter(
        Collector(
            envs[1],
            actor,
            frames_per_batch=steps * cfg.num_envs,
            total_frames=-1,
            device=device,
            no_cuda_sync=True,
            auto_register_policy_transforms=False,
        )
    )
    sides: dict[str, Callable[[], object]] = {
        "captured": ours.collect,
        "compiled": compiled.collect,
        "stock": lambda: _next(stock, eager=True),
        "stock_with_graphs": lambda: _next(stock, eager=False),
    }
    times: dict[str, list[float]] = {name: [] for name in sides}
    for work in sides.values():
        for _ in range(WARMUP):
            work()
    for _ in range(rounds):
        for name, work in sides.items():
            times[name].append(milliseconds(work, device=device, repeats=1))
    env_states = 1000.0 * steps * cfg.num_envs
    figures = {
        f"{name}_env_states_per_s": env_states / statistics.median(ms) for name, ms in times.items()
    }
    for name in ("stock", "stock_with_graphs"):
        ratios = [other / own for other, own in zip(times[name], times["captured"], strict=True)]
        figures[f"captured_over_{name}"] = statistics.median(ratios)
    ratios = [other / own for other, own in zip(times["captured"], times["compiled"], strict=True)]
    figures["compiled_over_captured"] = statistics.median(ratios)
    for env in envs:
        env.close(raise_if_closed=False)
    return figures


@torch.no_grad()
def _next(rollouts: Iterator[Any], *, eager: bool) -> object:
    """Collect one rollout; with `eager`, physics is issued launch by launch."""
    with live_launches() if eager else nullcontext():
        return next(rollouts)


def main() -> None:
    """Measure each number of envs, print the table and write the figures."""
    own, words = command_line.split(sys.argv[1:], {"num_envs": "4096", "steps": str(STEPS)})
    steps = command_line.whole_number("steps", own["steps"])
    if not any(word.startswith("task=") for word in words):
        words.append("task=cartpole_balance")
    table = Table(title="captured rollout beside TorchRL's Collector")
    sides = ("compiled", "captured", "stock", "stock_with_graphs")
    ratios = ("compiled_over_captured", "captured_over_stock", "captured_over_stock_with_graphs")
    for column in ("envs", *sides, *ratios):
        table.add_column(column, justify="right")
    figures: dict[str, float] = {}
    device = torch.device("cpu")
    for num_envs in command_line.whole_numbers("num_envs", own["num_envs"]):
        sizes = [f"num_envs={num_envs}", f"data.num_env_states_per_minibatch={steps * num_envs}"]
        cfg = command_line.compose(
            [*words, *sizes, "data.num_minibatches=1", "logger=none", "trainer.eval_episodes=0"]
        )
        device = cfg.resolved_device()
        found = measure(cfg, steps=steps)
        robot = cfg.task_name.split("_")[0]
        prefix = f"{report.device_label(device)}/{robot}/{num_envs}"
        figures |= {f"{prefix}/{name}": round(value, 3) for name, value in found.items()}
        speeds = [f"{found[f'{side}_env_states_per_s']:,.0f}" for side in sides]
        table.add_row(str(num_envs), *speeds, *(f"{found[ratio]:.2f}" for ratio in ratios))
    Console().print(table)
    path = report.write("collector", figures=figures, device=device, module="benchmarks.collector")
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
