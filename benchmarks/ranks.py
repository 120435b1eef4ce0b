"""This benchmark compares training on several GPUs of a machine with training on one.

    python -m benchmarks.ranks

trains `TASKS` on one GPU and on all (or `ranks=N`), as torchrun does it, with as many envs per rank, and prints whole
iterations in ms and env states/s of both, their ratio, and the host's waits and copies in one iteration of rank 0; then
the seconds until Go1 follows its command on one GPU and on all, the median of `seeds` (1,2,3,4,5; none with
`seeds=none`), without the first iteration; and the seconds until all ranks have ended after one was killed. With
`tasks=go1_velocity_flat:4096` others are chosen, and `device=cpu` tries it out. Figures go to
benchmarks/results/ranks.json. NVLink multicast is off (`NCCL_NVLS_ENABLE=0`), which the file records.
"""

from __future__ import annotations

import csv
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command_line, report
from benchmarks.host_traffic import host_traffic
from ksim_rl import conf, ranks
from ksim_rl.tables.table import load
from ksim_rl.trainers import build

TASKS = "go1_velocity_flat:16384,go1_velocity_flat:4096,g1_velocity_flat:4096"
OPTIONS = {"tasks": TASKS, "seeds": "1,2,3,4,5", "ranks": "0", "device": "cuda", "env_states": "60e6"}
LEVELS = load("velocity").rows["ppo/go1"].levels
NVLS = {"NCCL_NVLS_ENABLE": "0"}
WARMUP, TIMED = {"cuda": 12, "cpu": 1}, {"cuda": 20, "cpu": 2}


def worker(overrides: list[str]) -> None:
    """Measure whole iterations on this rank, and print the figures as JSON on rank 0."""
    with ranks.joined("train"):
        cfg = conf.compose([*overrides, "logger=none", "trainer.eval_episodes=0"])
        trainer = build(cfg)
        device = trainer.update.device

        def settled() -> float:
            trainer.settle()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            return time.perf_counter()

        for _ in range(WARMUP[device.type]):
            trainer.iterate()
        began = settled()
        for _ in range(TIMED[device.type]):
            trainer.iterate()
        seconds = (settled() - began) / TIMED[device.type]
        figures = {"iteration_ms": seconds * 1000.0, "env_states_per_s": trainer.num_env_states / seconds}
        if device.type == "cuda":
            figures |= host_traffic(trainer.iterate)
        settled()
        if ranks.rank() == 0:
            print(json.dumps(figures), flush=True)


def start(size: int, module: str, *arguments: str, folder: Path) -> subprocess.Popen[str]:
    """Start a module on so many ranks of this machine."""
    command = [sys.executable, "-m"]
    if size > 1:
        command += ["torch.distributed.run", "--rdzv-backend=c10d", "--rdzv-endpoint=localhost:0"]
        command += [f"--nproc-per-node={size}", "-m"]
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", ""))))
    env = os.environ | NVLS | {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        [*command, module, *arguments], cwd=folder, env=env, stdout=subprocess.PIPE, text=True
    )


def output(process: subprocess.Popen[str]) -> str:
    """Wait for a process, and return what it printed; SystemExit where it failed."""
    text, _ = process.communicate()
    if process.returncode not in (0, 1):  # 1 is "not solved"
        raise SystemExit(f"{process.args} ended with exit code {process.returncode}")
    return text


def seconds_to_track(size: int, seed: str, *, env_states: float, device: str) -> float:
    """Train Go1 until it follows its command, and return the seconds without the first iteration; else infinity."""
    with tempfile.TemporaryDirectory() as name:
        levels = ", ".join(f"{metric}: {value}" for metric, value in LEVELS.items())
        iterations = int(env_states / (4096 * 24 * size))
        output(
            start(
                size,
                "ksim_rl.cli.main",
                "train",
                "task=go1_velocity_flat",
                f"device={device}",
                "num_envs=4096",
                f"seed={seed}",
                f"trainer.num_iterations={iterations}",
                f"trainer.stop_at={{{levels}}}",
                "trainer.eval_episodes=0",
                "trainer.video=false",
                "trainer.checkpoint_interval=0",
                "hydra.run.dir=run",
                folder=Path(name),
            )
        )
        with open(Path(name, "run", "metrics.csv"), newline="") as file:
            rows = list(csv.DictReader(file))
        last = rows[-1]
        if any(not last.get(metric) or float(last[metric]) < value for metric, value in LEVELS.items()):
            return float("inf")
        return float(last["seconds"]) - float(rows[0]["seconds"])


def seconds_to_end(size: int, *, device: str) -> float:
    """Kill a rank, and return the seconds until all have ended."""
    with tempfile.TemporaryDirectory() as name:
        run = ["task=cartpole_balance", f"device={device}", "num_envs=64", "trainer.num_iterations=1000000"]
        process = start(size, "ksim_rl.cli.main", "train", *run, "hydra.run.dir=run", folder=Path(name))
        assert process.stdout is not None
        for line in process.stdout:
            if "iteration 3/" in line:
                break
        found = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=True)
        os.kill(int(found.stdout.split()[-1]), signal.SIGKILL)
        began = time.monotonic()
        process.communicate()
        return time.monotonic() - began


def main() -> None:
    """Measure all tasks, then learning, then a kill, and write the figures."""
    if sys.argv[1:2] == ["worker"]:
        worker(sys.argv[2:])
        return
    own = command_line.options(sys.argv[1:], OPTIONS)
    device = torch.device(own["device"])
    size = int(own["ranks"]) or (torch.cuda.device_count() if device.type == "cuda" else 2)
    if size < 2:
        raise ValueError(f"device={device} has {size} of it: ranks are measured on two or more")
    label = f"{report.device_label(device)}x{size}"
    table = Table("task", "envs", "1: ms", f"{size}: ms", "1: env states/s", f"{size}: env states/s", "ratio")
    figures: dict[str, float] = {}
    here = Path(__file__).parents[1]
    for word in own["tasks"].split(","):
        task, _, num_envs = word.partition(":")
        run = (f"task={task}", f"num_envs={num_envs}", f"device={device}", "collector.rollout_length=24")
        one, all_ranks = (
            json.loads(output(start(count, "benchmarks.ranks", "worker", *run, folder=here)).splitlines()[-1])
            for count in (1, size)
        )
        ratio = all_ranks["env_states_per_s"] / one["env_states_per_s"]
        prefix = f"{label}/{task}/{num_envs}"
        name = {2: "two"}.get(size, str(size))
        figures |= {f"{prefix}/{name}_over_one": round(ratio, 3)}
        figures |= {f"{prefix}/one_{key}": round(value, 3) for key, value in one.items()}
        figures |= {f"{prefix}/all_{key}": round(value, 3) for key, value in all_ranks.items()}
        times = [f"{part['iteration_ms']:.1f}" for part in (one, all_ranks)]
        speeds = [f"{part['env_states_per_s']:,.0f}" for part in (one, all_ranks)]
        table.add_row(task, num_envs, *times, *speeds, f"{ratio:.3f}")
    Console().print(table)
    seeds = [] if own["seeds"] == "none" else own["seeds"].split(",")
    if seeds:
        options = {"env_states": float(own["env_states"]), "device": own["device"]}
        medians = [
            statistics.median(seconds_to_track(count, seed, **options) for seed in seeds)
            for count in (1, size)
        ]
        print(f"seconds to track on one and on {size}: {medians[0]:.1f}, {medians[1]:.1f}")
        figures |= {
            f"{label}/seconds_to_track/{count}": value
            for count, value in zip((1, size), medians, strict=True)
        }
        figures[f"{label}/seconds_to_track/ratio"] = round(medians[1] / medians[0], 3)
    killed = seconds_to_end(size, device=own["device"])
    print(f"all ranks had ended {killed:.1f} s after one was killed")
    figures[f"{label}/killed/seconds_to_end"] = round(killed, 1)
    path = report.write("ranks", figures=figures, device=device, module="benchmarks.ranks", environment=NVLS)
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
