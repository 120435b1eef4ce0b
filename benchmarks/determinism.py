"""Are equal runs equal? This benchmark trains the same config from the same seed again, and compares bit for bit.

    python -m benchmarks.determinism device=cuda

trains each task twice (`runs=3` for three times) for 200 iterations (`iterations=N`), in one process. After iterations
1, 2, 3, 5, 10 and each tenth from then on it hashes, on the device, all that a checkpoint holds, the rollout, the
dataset, the metrics, and all arrays of the physics: a hash is a sum of whole numbers, which has no order. Where runs
differ, it prints the names of the first tensors that do, and after which iteration. Compare as well the hash of a whole
run between two calls of this command: it is printed, and in the file. `tasks=go1_velocity_flat,arm_push` trains a part,
`switch=arm_push` times that one with and without torch's switch for equal runs; other words are overrides of `ksim-rl
train`, for all tasks. Figures go to benchmarks/results/determinism.json.

MuJoCo Warp hands out the places of contacts in a pool of all worlds in no order, so arrays that are laid out like the
pool, or hold places in it, differ where nothing else does. They are compared, printed and counted apart.
"""

from __future__ import annotations

import gc
import hashlib
import itertools
import json
import os
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from benchmarks import command_line, report
from benchmarks.throughput import iteration_ms
from ksim_rl.checks import check_choice
from ksim_rl.physics import views
from ksim_rl.trainers import RunCfg, Trainer
from ksim_rl.trainers.build import build

NAME = "determinism"
OWN_OPTIONS = {"tasks": "all", "runs": "2", "iterations": "200", "switch": ""}
SWITCHED = "go1_velocity_flat"
"""The task that is timed with torch's switch for equal runs as well, if it is compared."""
CLUTTER = tuple(
    word
    for index, (x, y) in enumerate(itertools.product((0.2, 0.3, 0.4), (-0.24, 0.24)))
    for word in (
        f"+task.scene.objects.cube_{index}=${{task.scene.objects.cube}}",
        f"+task.scene.placements.cube_{index}={{pos:[{x},{y},0.0]}}",
    )
)
TASKS: dict[str, tuple[str, ...]] = {
    "go1_velocity_flat": ("task=go1_velocity_flat",),
    "g1_velocity_flat": ("task=g1_velocity_flat",),
    "go1_velocity_flat_fast_sac": ("task=go1_velocity_flat", "objective=fast_sac"),
    # Of the tasks on our own robots the one with most contacts, 3.9 in a world under random actions (humanoid_get_up
    # has 1.7, humanoid_velocity_flat 1.3). None has 20, but with six more cubes about the arm.
    "arm_push": ("task=arm_push",),
    "arm_clutter": ("task=arm_push", *CLUTTER),
    # Pictures too: the renderer's bounding volumes are built in parallel.
    "cartpole_balance_pixels": ("task=cartpole_balance_pixels",),
}
QUIET = (
    "logger=none",
    "trainer.eval_episodes=0",
    "trainer.video=false",
    "trainer.checkpoint_interval=0",
)
FIRST_LOOKS, LATER_LOOKS = (1, 2, 3, 5), 10
MOST_NAMES = 40
"""Names that are printed of one iteration."""
OF_THE_POOL = ("/world/contact.", "/world/efc.id")
# Bytes that are hashed at a time, a multiple of 8, so that a replay needs no second one's memory.
CHUNK = 2**26
# The constants of splitmix64, as signed numbers, which wrap.
_STEP, _MIX = -0x61C8864680B583EB, (-0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15)


@dataclass
class Bits:
    """The hashes of a run, by the iteration that they were taken after, and then by the path of a tensor or value."""

    looks: dict[int, dict[str, Any]] = field(default_factory=dict)
    contacts_per_world: float = 0.0

    def take(self, trainer: Trainer) -> None:
        """Hash everything that there is now; only `read` waits for the device."""
        self.looks[trainer.iteration] = {
            path: hash_of(leaf) if isinstance(leaf, Tensor) else json.dumps(leaf, default=repr)
            for path, leaf in leaves(state_of(trainer))
        }

    def read(self) -> None:
        """Bring the hashes to the host."""
        for look in self.looks.values():
            look.update(
                {path: value.item() for path, value in look.items() if isinstance(value, Tensor)}
            )

    @property
    def digest(self) -> str:
        """One hash of all that was the same in each run if equal runs are equal."""
        counted = {
            at: {k: v for k, v in look.items() if counts(k)} for at, look in self.looks.items()
        }
        return hashlib.sha256(json.dumps(counted, sort_keys=True).encode()).hexdigest()[:16]


def hash_of(tensor: Tensor) -> Tensor:
    """Return a number, int64 [] on its device, which changes with any bit of a tensor and its place."""
    flat = tensor.detach().contiguous().reshape(-1).view(torch.uint8)
    total = torch.zeros((), dtype=torch.int64, device=tensor.device)
    for begin in range(0, flat.numel(), CHUNK):
        part = flat[begin : begin + CHUNK]
        words = pad(part, (0, -part.numel() % 8)).clone().view(torch.int64)
        places = torch.arange(begin // 8 + 1, begin // 8 + 1 + words.numel(), device=tensor.device)
        mixed = words ^ (places * _STEP)
        mixed = (mixed ^ (mixed >> 30)) * _MIX[0]
        mixed = (mixed ^ (mixed >> 27)) * _MIX[1]
        total += (mixed ^ (mixed >> 31)).sum()
    return total


def leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the tensors and plain values of nested state, with their paths."""
    if isinstance(node, (Mapping, TensorDictBase)):
        for key, child in node.items():
            yield from leaves(child, f"{path}/{key}")
    else:
        yield path, node


def state_of(trainer: Trainer) -> dict[str, Any]:
    """Return what a checkpoint holds but for the seconds, and what it need not hold."""
    state = {key: value for key, value in trainer.state_dict().items() if key != "seconds"}
    state["rollout"] = trainer.rollout_ET
    storage = getattr(getattr(trainer.update, "dataset", None), "_storage", None)
    if getattr(storage, "initialized", False):
        state["dataset"] = getattr(storage, "_storage", {})
    state["metrics"] = trainer.update.metrics()
    world = _world(trainer)
    if world is not None:
        # What only MuJoCo Warp's own solver writes is uninitialized memory.
        names = [
            name for name in views.arrays(world.warp_data_E) if not name.startswith("efc.jtdaj")
        ]
        state["world"] = {name: world.last_substep(name) for name in names}
    return state


def counts(path: str) -> bool:
    """Whether what lies there has to be equal in equal runs: it is not laid out like the pool of contacts."""
    return not path.startswith(OF_THE_POOL)


def is_looked_at(iteration: int, last: int) -> bool:
    """Whether the tensors are hashed after this iteration."""
    return iteration in FIRST_LOOKS or iteration % LATER_LOOKS == 0 or iteration == last


def train(cfg: RunCfg, *, iterations: int, change: Callable[[Trainer], None] | None = None) -> Bits:
    """Train from the start and return the hashes; `change`, if any, may spoil the run after each iteration."""
    trainer, bits = build(cfg), Bits()
    for iteration in range(1, iterations + 1):
        trainer.iterate()
        if change is not None:
            change(trainer)
        if is_looked_at(iteration, iterations):
            bits.take(trainer)
    trainer.settle()
    bits.read()
    world = _world(trainer)
    if world is not None:
        bits.contacts_per_world = float(world.last_substep("nacon").item()) / world.num_envs
    trainer.collector.env.close(raise_if_closed=False)
    return bits


def on_over_off(cfg: RunCfg) -> float:
    """Return the speed of an iteration with torch's switch for equal runs, relative to that without it."""
    times: dict[bool, list[float]] = {True: [], False: []}
    try:
        # In an order in which a GPU that gets slower harms both.
        for on in (False, True, True, False):
            torch.use_deterministic_algorithms(on)
            times[on].append(iteration_ms(build(cfg)))
            _free()
    finally:
        torch.use_deterministic_algorithms(False)
    return statistics.mean(times[False]) / statistics.mean(times[True])


def differing(runs: Sequence[Bits]) -> dict[int, list[str]]:
    """Return the paths at which a run differs from the first, or that only one has, by iteration."""
    first, *others = runs
    found = {}
    for iteration, look in first.looks.items():
        paths = dict.fromkeys(path for run in runs for path in run.looks[iteration])
        found[iteration] = [
            path
            for path in paths
            if any(
                path not in look or run.looks[iteration].get(path) != look[path] for run in others
            )
        ]
    return found


def explain(found: Mapping[int, Sequence[str]]) -> list[str]:
    """Return lines that name what differs, after each iteration until something that counts has differed twice."""
    lines, seen = [], 0
    for iteration, paths in found.items():
        counted, pool = [p for p in paths if counts(p)], [p for p in paths if not counts(p)]
        if pool:
            lines.append(
                f"after iteration {iteration}, in the order of the pool: {_names(pool, most=6)}"
            )
        if counted:
            lines.append(
                f"after iteration {iteration}, {len(counted)} differ: {_names(counted, most=MOST_NAMES)}"
            )
            seen += 1
        if seen == 2:
            break
    return lines


def compare(
    cfg: RunCfg, *, runs: int, iterations: int
) -> tuple[dict[str, float], list[str], list[str]]:
    """Train equal runs; return the figures of their end, the hash of each, and lines that say what differs."""
    bits = []
    for _ in range(runs):
        bits.append(train(cfg, iterations=iterations))
        _free()
    found = differing(bits)
    figures = {
        "tensors": float(sum(map(counts, bits[0].looks[iterations]))),
        "tensors_that_differ": float(sum(map(counts, found[iterations]))),
        "of_the_pool_that_differ": float(sum(not counts(path) for path in found[iterations])),
        "first_iteration_that_differs": float(
            next((at for at, paths in found.items() if any(map(counts, paths))), 0)
        ),
        "iterations": float(iterations),
        "contacts_per_world": round(bits[0].contacts_per_world, 2),
    }
    return figures, [run.digest for run in bits], explain(found)


def main() -> int:
    """Compare the runs of each task, print and write what differs; the exit code says whether anything does."""
    own, overrides = command_line.split(sys.argv[1:], OWN_OPTIONS)
    runs = command_line.whole_number("runs", own["runs"], least=2)
    iterations = command_line.whole_number("iterations", own["iterations"])
    wanted = list(TASKS) if own["tasks"] == "all" else own["tasks"].split(",")
    switched = (
        own["switch"].split(",") if own["switch"] else [task for task in wanted if task == SWITCHED]
    )
    for task in wanted:
        check_choice("tasks", task, TASKS)
    for task in switched:
        check_choice("switch", task, wanted)
    # Read when cuBLAS starts; torch's switch asks for it.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    failed = False
    for task in wanted:
        cfg = command_line.compose([*TASKS[task], *QUIET, *overrides])
        device = cfg.resolved_device()
        figures, hashes, lines = compare(cfg, runs=runs, iterations=iterations)
        if task in switched:
            figures["on_over_off"] = round(on_over_off(cfg), 3)
        prefix = f"{report.device_label(device)}/{task}"
        for line in lines:
            print(line)
        print(
            f"{prefix}: {figures['tensors_that_differ']:.0f} of {figures['tensors']:.0f} tensors differ after "
            f"{iterations} iterations of {cfg.num_envs} envs; hashes {', '.join(hashes)}",
            flush=True,
        )
        report.write(
            NAME,
            figures={f"{prefix}/{name}": value for name, value in figures.items()},
            device=device,
            module="benchmarks.determinism",
            hashes={prefix: hashes},
            first_differences={prefix: lines},
        )
        failed |= figures["tensors_that_differ"] > 0
    return int(failed)


def _world(trainer: Trainer) -> Any:
    return getattr(getattr(trainer.collector.env, "base_env", None), "world", None)


def _free() -> None:
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def _names(paths: Sequence[str], *, most: int) -> str:
    return ", ".join(paths[:most]) + (f" and {len(paths) - most} more" if len(paths) > most else "")


if __name__ == "__main__":
    command_line.run(main)
