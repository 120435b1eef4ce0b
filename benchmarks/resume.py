"""Is a run that is saved and resumed in a new process the run that never stopped? Compared tensor by tensor.

    python -m benchmarks.resume
    python -m benchmarks.resume device=cuda mlp fast_sac

trains each case, or those named, twice with the command `ksim-rl`: N iterations at a stretch, and N/2, then `ksim-rl
resume` in a new process. The final checkpoints hold all that a next iteration depends on; every tensor and value of
them is compared bit for bit. Figures go to benchmarks/results/resume.json, as `<device>/<case>/<figure>`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks import command_line, report
from ksim_rl.checks import check_choice
from ksim_rl.device import state_tree
from ksim_rl.device.streams import checked_device
from ksim_rl.trainers import checkpoint

TERM = "task.observations.actor.terms"
# A robot of our own, with everything that has a state: noise with a bias and a walk, delays, histories, randomization
# at startup and at resets, pushes, commands, a level that rises, a reward weight and command ranges that follow it.
TASK = (
    "task=quadruped_velocity_flat",
    "num_envs=6",
    "task.episode_length_s=0.5",
    "task.events.push_robot.interval_range_s=[0.1,0.3]",
    f"{TERM}.base_ang_vel.noise.walk_std=0.01",
    f"{TERM}.base_lin_vel.noise.bias={{_target_: ksim_rl.transforms.noise.cfg.GaussianNoise, std: 0.1}}",
    f"{TERM}.base_ang_vel.delay={{min_lag: 0, max_lag: 3, resample_every: 5}}",
    f"{TERM}.projected_gravity.history=3",
    "+task.events.mass={_target_: ksim_rl.mdp.RandomizeBodyMass, mode: reset, bodies: [trunk], "
    "ranges: [0.8, 1.2], operation: scale}",
    "+task.curriculum.level={_target_: ksim_rl.mdp.LinearLevel, end_step: 100}",
    "+task.curriculum.weight={_target_: ksim_rl.mdp.RewardWeightByLevel, "
    "reward: track_linear_velocity, start: 1.0, end: 2.0}",
    # Its stages would write the ranges that the level below writes.
    "~task.curriculum.command_ranges",
    "+task.curriculum.speed={_target_: ksim_rl.mdp.CommandRangesByLevel, command: twist, "
    "start: {lin_vel_x: [-0.5, 0.5]}, end: {lin_vel_x: [-1.0, 1.0]}}",
    "modules.actor.hidden_dims=[16]",
    "modules.critic.hidden_dims=[16]",
    "trainer.eval_episodes=0",
    "trainer.video=false",
    "trainer.num_threads=1",
    "logger=none",
)
ON_POLICY = ("data.num_env_states_per_minibatch=32", "data.num_minibatches=3")
OFF_POLICY = (
    "data.num_env_states_per_minibatch=24",
    "data.num_minibatches=4",
    "data.num_steps=16",
    "data.capacity=80",
    "data.learning_starts=16",
)
CASES = {
    "mlp": ON_POLICY,
    "lstm": (
        "modules=lstm",
        *ON_POLICY,
        "modules.recurrent_actor.hidden_dim=8",
        "modules.recurrent_critic.hidden_dim=8",
    ),
    "sac": ("objective=sac", *OFF_POLICY),
    "fast_sac": ("objective=fast_sac", "data.save_replay=true", *OFF_POLICY),
}
NUM_ITERATIONS = 6
# The first of these that a tensor's path begins with names its component; else it is the path's first word.
COMPONENTS = {
    "/update/actor": "policy and its normalizers",
    "/update/critic": "critics and their normalizers",
    "/update/recurrent": "hidden states",
    "/update/optimizer": "optimizers",
    "/update/replay": "replay",
    "/update": "learning: samplers, targets, guards",
    "/collector": "EnvState to start from",
    "/env/base_env.world.field": "randomized model",
    "/env/base_env.world": "physics",
    "/env/base_env.env.commands": "commands",
    "/env/base_env.env.events": "events",
    "/env/base_env.env.rewards~1": "rewards",
    "/env/base_env.env.curriculum": "curricula",
    "/env/base_env.env.reward_weights": "curricula",
    "/env/base_env.env.shared": "curricula",
    "/env/base_env.env": "env: clocks, actions, contacts, logs",
    "/env/transform": "transforms: noise, delay, history",
    "/env/last_root": "EnvState to start from",
    "/random": "random generators",
}


@dataclass
class Comparison:
    """What two checkpoints have in common, by component."""

    compared: Counter[str] = field(default_factory=Counter)
    differing: dict[str, list[str]] = field(default_factory=dict)

    @property
    def tensors_compared(self) -> int:
        """Tensors and plain values."""
        return self.compared.total()

    @property
    def tensors_that_differ(self) -> int:
        """Those that are not the same bit for bit, or that only one side has."""
        return sum(map(len, self.differing.values()))


def main() -> None:
    """Run the cases that are named (or all), print the table and write it."""
    own, named = command_line.split(sys.argv[1:], {"device": "cpu"})
    device, wanted = checked_device(own["device"]), named or list(CASES)
    label = report.device_label(device)
    for name in wanted:
        check_choice("case", name, CASES)
    found = {}
    for name in wanted:
        with tempfile.TemporaryDirectory() as folder:
            overrides = (*TASK, *CASES[name])
            found[name] = compare_runs(
                overrides, Path(folder), num_iterations=NUM_ITERATIONS, device=device.type
            )
    Console(width=140).print(_table(found))
    figures = {
        f"{label}/{case}/{figure}": getattr(comparison, figure)
        for case, comparison in found.items()
        for figure in ("tensors_compared", "tensors_that_differ")
    }
    path = report.write(
        "resume",
        figures=figures,
        device=device,
        module="benchmarks.resume",
        tensors_compared=sum(comparison.tensors_compared for comparison in found.values()),
        tensors_that_differ=sum(comparison.tensors_that_differ for comparison in found.values()),
        components={
            f"{label}/{case}": {
                component: {
                    "tensors_compared": count,
                    "that_differ": comparison.differing.get(component, []),
                }
                for component, count in comparison.compared.items()
            }
            for case, comparison in found.items()
        },
    )
    print(f"written to {path}")
    sys.exit(any(comparison.tensors_that_differ for comparison in found.values()))


def run_command(*words: str) -> None:
    """Run `ksim-rl <words>` in a process of its own."""
    command = [sys.executable, "-m", "ksim_rl.cli.main", *words]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        raise RuntimeError(
            f"ksim-rl {words[0]} ended with exit code {done.returncode}:\n{done.stdout}"
        )


def compare_runs(
    overrides: tuple[str, ...],
    folder: Path,
    *,
    num_iterations: int,
    device: str = "cpu",
    train: Callable[..., None] = run_command,
) -> Comparison:
    """Train at a stretch and in two processes, and compare the final checkpoints; `train` runs what is not resumed."""
    straight, halves = folder / "straight", folder / "halves"
    overrides = (*overrides, f"device={device}")
    train(
        "train", *overrides, f"trainer.num_iterations={num_iterations}", f"hydra.run.dir={straight}"
    )
    train(
        "train",
        *overrides,
        f"trainer.num_iterations={num_iterations // 2}",
        f"hydra.run.dir={halves}",
    )
    run_command("resume", str(halves), "--num-iterations", str(num_iterations), "--device", device)
    one, other = (checkpoint.load_latest(run) for run in (straight, halves))
    if one.iteration != num_iterations or other.iteration != num_iterations:
        raise RuntimeError(f"the runs ended after {one.iteration} and {other.iteration} iterations")
    return compare(one.state, other.state)


def compare(one: state_tree.State, other: state_tree.State) -> Comparison:
    """Compare two states leaf by leaf; only the run's seconds may differ."""
    ours, theirs = (
        {**tensors, **values} for tensors, values in map(state_tree.split, (one, other))
    )
    comparison = Comparison()
    for path in dict.fromkeys([*ours, *theirs]):
        if path == "/seconds":
            continue
        component = next(
            (name for prefix, name in COMPONENTS.items() if path.startswith(prefix)),
            path.split("/")[1],
        )
        comparison.compared[component] += 1
        if path not in ours or path not in theirs or not _same(ours[path], theirs[path]):
            comparison.differing.setdefault(component, []).append(path)
    return comparison


def _same(one: object, other: object) -> bool:
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        # Bytes, so that NaN equals NaN and -0 differs from 0.
        same_kind = (one.dtype, one.shape) == (other.dtype, other.shape)
        return same_kind and torch.equal(_bytes(one), _bytes(other))
    return type(one) is type(other) and one == other


def _bytes(tensor: Tensor) -> Tensor:
    return tensor.contiguous().reshape(-1).view(torch.uint8)


def _table(found: dict[str, Comparison]) -> Table:
    table = Table(
        title=f"{NUM_ITERATIONS} iterations at a stretch, and {NUM_ITERATIONS // 2} + a new process"
    )
    for column in ("case", "component", "tensors compared", "differ"):
        table.add_column(column, justify="left" if column in ("case", "component") else "right")
    for case, comparison in found.items():
        for component, count in comparison.compared.items():
            table.add_row(
                case, component, str(count), str(len(comparison.differing.get(component, [])))
            )
        totals = (str(comparison.tensors_compared), str(comparison.tensors_that_differ))
        table.add_row(case, "[bold]all[/bold]", *totals, end_section=True)
    return table


if __name__ == "__main__":
    command_line.run(main)
