"""Compares training on several GPUs of a machine with training on one.

    python -m benchmarks.ranks

trains `TASKS` on one GPU and on all (or `ranks=N`), as torchrun does it, with as many envs per rank, and prints whole
iterations in ms and env states/s of both, their ratio, and the host's waits and copies in one iteration of rank 0;
then the seconds until all ranks have ended after one was killed (`kill=no` leaves it out); and the seconds until Go1
follows its command on one GPU (one seed on each at a time) and on all, the median of `seeds` (1,2,3,4,5; none with
`seeds=none`), without the first iteration; there the env states per update are the same on all as on one, with shorter
rollouts. With `tasks=go1_velocity_flat:4096` others are chosen (none with
`tasks=none`), and `device=cpu` tries it out. A third part names the algorithm: `g1_velocity_flat:4096:fast_sac`.

Figures go to benchmarks/results/ranks.json after each part, so that the figures of one part stay when a later one runs
out of time. All processes have the variables of `NCCL`, which leave NVLink multicast off and which the file records.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.host_traffic import host_traffic
from ksim_rl import conf, ranks
from ksim_rl.tables.table import load
from ksim_rl.trainers import build

TASKS = (
    "go1_velocity_flat:16384,go1_velocity_flat:4096,g1_velocity_flat:4096,"
    "g1_velocity_flat:4096:fast_sac"
)
OPTIONS = {
    "tasks": TASKS,
    "seeds": "1,2,3,4,5",
    "ranks": "0",
    "device": "cuda",
    "env_states": "60e6",
    "kill": "yes",
}
LEVELS = load("velocity").rows["ppo/go1"].levels
# Each switches off what would use NVLink multicast, which not every machine allows.
NCCL = {
    "NCCL_NVLS_ENABLE": "0",
    "TORCH_SYMM_MEM_DISABLE_MULTICAST": "1",
    "NVSHMEM_DISABLE_NVLS": "1",
}
ROLLOUT_LENGTH = 24
# Rollouts 32 and 64 after the recording compare the recorded step with Python. Both lie outside of what is timed, as
# such rollouts are rare in a long run.
WARMUP = {"cuda": 40, "cpu": 1}
TIMED = {"cuda": 20, "cpu": 2}


def worker(device: str, tasks: str) -> None:
    """Measure whole iterations of each task on this rank, and print the figures of each as JSON on rank 0."""
    with ranks.joined("train"):
        for word in tasks.split(","):
            figures = measured(device, *word.split(":"))
            # The next task's envs need the memory of this one's, which its circles of references would keep.
            gc.collect()
            if ranks.rank() == 0:
                print(json.dumps(figures), flush=True)


def measured(device: str, task: str, num_envs: str, objective: str = "ppo") -> dict[str, float]:
    """Return what whole iterations of a task take; algorithms with a replay keep their own rollout length."""
    run = [
        f"task={task}",
        f"objective={objective}",
        f"num_envs={num_envs}",
        f"device={device}",
    ]
    if objective == "ppo":
        run.append(f"collector.rollout_length={ROLLOUT_LENGTH}")
    trainer = build(conf.compose([*run, "logger=none", "trainer.eval_episodes=0"]))
    own = trainer.update.device

    def settled() -> float:
        trainer.settle()
        if own.type == "cuda":
            torch.cuda.synchronize(own)
        return time.perf_counter()

    for _ in range(WARMUP[own.type]):
        trainer.iterate()
    began = settled()
    for _ in range(TIMED[own.type]):
        trainer.iterate()
    seconds = (settled() - began) / TIMED[own.type]
    figures = {
        "iteration_ms": seconds * 1000.0,
        "env_states_per_s": trainer.num_env_states / seconds,
    }
    if own.type == "cuda":
        figures |= host_traffic(trainer.iterate)
    settled()
    return figures


def start(
    size: int, module: str, *arguments: str, folder: Path, gpu: int | None = None
) -> subprocess.Popen[str]:
    """Start a module on so many ranks of this machine, or on one of its GPUs."""
    command = [sys.executable, "-m"]
    if size > 1:
        command += ["torch.distributed.run", "--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0"]
        command += [f"--nproc-per-node={size}", "-m"]
    path = os.pathsep.join(
        filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")))
    )
    env = os.environ | NCCL | {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}
    if gpu is not None:
        env["CUDA_VISIBLE_DEVICES"] = str(gpu)
    return subprocess.Popen(
        [*command, module, *arguments], cwd=folder, env=env, stdout=subprocess.PIPE, text=True
    )


def output(process: subprocess.Popen[str]) -> str:
    """Wait for a process, and return what it printed; SystemExit where it failed."""
    text, _ = process.communicate()
    if process.returncode:
        raise SystemExit(f"{process.args} ended with exit code {process.returncode}")
    return text


class Rows:
    """Keeps what a run reports in memory, as a logger of it."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        """Keep the metrics of an iteration."""
        self.rows.append(dict(metrics))

    def close(self) -> None:
        """Have nothing to close."""


def learner(device: str, env_states: str, seeds: str) -> None:
    """Let this rank learn with each seed in turn, and print the seconds of each as JSON on rank 0."""
    with ranks.joined("train"):
        for seed in seeds.split(","):
            seconds = seconds_to_track(seed, env_states=float(env_states), device=device)
            gc.collect()
            if ranks.rank() == 0:
                print(json.dumps({"seed": int(seed), "seconds": seconds}), flush=True)


def seconds_to_track(seed: str, *, env_states: float, device: str) -> float:
    """Train Go1 until it follows its command, and return the seconds without the first iteration; else infinity."""
    iterations = max(2, int(env_states / (4096 * ROLLOUT_LENGTH)))
    # As many env states per update on any number of ranks: twice as many do not halve the updates that learning takes.
    run = [
        "task=go1_velocity_flat",
        f"device={device}",
        "num_envs=4096",
        f"seed={seed}",
        "logger=none",
    ]
    run += [f"collector.rollout_length={ROLLOUT_LENGTH // ranks.size()}"]
    run += [f"trainer.num_iterations={iterations}", "trainer.eval_episodes=0"]
    levels = ", ".join(f"{metric}: {value}" for metric, value in LEVELS.items())
    trainer = build(conf.compose([*run, f"trainer.stop_at={{{levels}}}"]))
    kept = Rows()
    trainer.loggers = [kept]
    outcome = trainer.train()
    return (
        kept.rows[-1]["seconds"] - kept.rows[0]["seconds"] if outcome.target_met else float("inf")
    )


def seconds_of_seeds(
    size: int, seeds: list[str], *, gpus: int, env_states: str, device: str
) -> dict[int, float]:
    """Return `seconds_to_track` of each seed on so many ranks; runs of one rank go side by side, on all GPUs."""
    here = Path(__file__).parents[1]
    shares = (
        [(seeds[gpu::gpus], gpu) for gpu in range(gpus)] if size == 1 and gpus else [(seeds, None)]
    )
    runs = [
        start(
            size,
            "benchmarks.ranks",
            "learner",
            device,
            env_states,
            ",".join(share),
            folder=here,
            gpu=gpu,
        )
        for share, gpu in shares
        if share
    ]
    lines = [line for run in runs for line in output(run).splitlines() if line.startswith("{")]
    found = {one["seed"]: one["seconds"] for one in map(json.loads, lines)}
    print(f"{size} of {device}: {found}", flush=True)
    return found


def seconds_to_end(size: int, task: str, num_envs: str, *, device: str) -> float:
    """Kill a rank of a run of a task, and return the seconds until all have ended."""
    with tempfile.TemporaryDirectory() as name:
        run = [
            f"task={task}",
            f"device={device}",
            f"num_envs={num_envs}",
            "collector.rollout_length=24",
        ]
        run += ["trainer.num_iterations=1000000"]
        process = start(
            size, "ksim_rl.cli.main", "train", *run, "hydra.run.dir=run", folder=Path(name)
        )
        assert process.stdout is not None
        for line in process.stdout:
            if "iteration 3/" in line:
                break
        found = subprocess.run(
            ["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=True
        )
        os.kill(int(found.stdout.split()[-1]), signal.SIGKILL)
        began = time.monotonic()
        process.communicate()
        return time.monotonic() - began


def compare(tasks: str, size: int, *, device: str, label: str, saved: Callable[..., Path]) -> None:
    """Measure whole iterations of tasks on one rank and on `size`, print them side by side and save them."""
    table = Table(
        "task", "envs", "1: ms", f"{size}: ms", "1: env states/s", f"{size}: env states/s", "ratio"
    )
    by_size: list[list[dict[str, float]]] = []
    # All tasks in the same processes, whose start takes longer than what they measure.
    for count in (1, size):
        began, here = time.monotonic(), Path(__file__).parents[1]
        text = output(start(count, "benchmarks.ranks", "worker", device, tasks, folder=here))
        by_size.append([json.loads(line) for line in text.splitlines() if line.startswith("{")])
        print(f"{count} of {device}: {time.monotonic() - began:.0f} s", flush=True)
    for word, one, all_ranks in zip(tasks.split(","), *by_size, strict=True):
        task, num_envs, *objective = word.split(":")
        ratio = all_ranks["env_states_per_s"] / one["env_states_per_s"]
        prefix = "/".join([label, task, num_envs, *objective])
        name = {2: "two"}.get(size, str(size))
        figures = {f"{prefix}/{name}_over_one": round(ratio, 3)}
        figures |= {f"{prefix}/one_{key}": round(value, 3) for key, value in one.items()}
        figures |= {f"{prefix}/all_{key}": round(value, 3) for key, value in all_ranks.items()}
        saved(figures=figures)
        times = [f"{part['iteration_ms']:.1f}" for part in (one, all_ranks)]
        speeds = [f"{part['env_states_per_s']:,.0f}" for part in (one, all_ranks)]
        table.add_row(" ".join([task, *objective]), num_envs, *times, *speeds, f"{ratio:.3f}")
    Console().print(table)


def main() -> None:
    """Measure all tasks, then learning, then a kill, and write the figures."""
    parts = {"worker": worker, "learner": learner}
    if sys.argv[1:2] and sys.argv[1] in parts:
        parts[sys.argv[1]](*sys.argv[2:])
        return
    own = command_line.options(sys.argv[1:], OPTIONS)
    device = torch.device(own["device"])
    size = int(own["ranks"]) or (torch.cuda.device_count() if device.type == "cuda" else 2)
    if size < 2:
        raise ValueError(f"device={device} has {size} of it: ranks are measured on two or more")
    label = f"{report.device_label(device)}x{size}"
    saved = partial(
        report.write, "ranks", device=device, module="benchmarks.ranks", environment=NCCL
    )
    if own["tasks"] != "none":
        compare(own["tasks"], size, device=own["device"], label=label, saved=saved)
    if own["kill"] == "yes":
        killed = seconds_to_end(size, "go1_velocity_flat", "4096", device=own["device"])
        print(f"all ranks had ended {killed:.1f} s after one was killed", flush=True)
        saved(figures={f"{label}/killed/seconds_to_end": round(killed, 1)})
    if own["seeds"] != "none":
        gpus = size if device.type == "cuda" else 0
        medians, prefix = {}, f"{label}/seconds_to_track"
        for count in (size, 1):
            seconds = seconds_of_seeds(
                count,
                own["seeds"].split(","),
                gpus=gpus,
                env_states=own["env_states"],
                device=own["device"],
            )
            medians[count] = statistics.median(seconds.values())
            each = {f"{prefix}/{count}/{seed}": value for seed, value in seconds.items()}
            saved(figures={**each, f"{prefix}/{count}": medians[count]})
        print(f"seconds to track on one and on {size}: {medians[1]:.1f}, {medians[size]:.1f}")
        saved(figures={f"{prefix}/ratio": round(medians[size] / medians[1], 3)})
    print(f"written to {report.RESULTS / 'ranks.json'}")


if __name__ == "__main__":
    command_line.run(main)
