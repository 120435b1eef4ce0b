"""Times training beside mjlab's own training of the same task on the same machine.

    python -m benchmarks.peers --python OTHER_ENV/bin/python task=go1_velocity_flat num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`. mjlab wants other versions of MuJoCo than this project, so it runs in an
environment of its own, whose interpreter `--python` names; without one, or without mjlab in it, this says so in one
line and ends well. First the peer trains `ITERATIONS` iterations of its task as its own command does, then we do; each
is timed on the wall clock, from one iteration's log to the next, and the median of the second half counts. Both write
their logs for TensorBoard. Figures go to benchmarks/results/peers.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import torch

from benchmarks import command_line, report
from benchmarks.throughput import num_env_states, train_ms

ITERATIONS = 40
TASKS = {
    "go1_velocity_flat": "Mjlab-Velocity-Flat-Unitree-Go1",
    "g1_velocity_flat": "Mjlab-Velocity-Flat-Unitree-G1",
}

# Runs in the peer's environment, so it uses nothing of ours.
_PEER = """
import json, statistics, sys, time
from pathlib import Path
import torch
task, num_envs, iterations, folder = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
import mjlab.tasks
from importlib.metadata import version
from mjlab.scripts.train import TrainConfig, run_train
from rsl_rl.utils.logger import Logger
ends, log = [], Logger.log
def timed(self, *args, **kwargs):
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    ends.append(time.perf_counter())
    return log(self, *args, **kwargs)
Logger.log = timed
cfg = TrainConfig.from_task(task)
cfg.env.scene.num_envs = num_envs
cfg.agent.max_iterations = iterations
cfg.agent.logger = "tensorboard"
cfg.agent.upload_model = False
run_train(task, cfg, folder / "log")
times = [end - begin for begin, end in zip(ends, ends[1:])]
states = num_envs * cfg.agent.num_steps_per_env
rate = states / statistics.median(times[len(times) // 2:])
versions = {name: version(name) for name in ("mjlab", "rsl-rl-lib", "mujoco", "mujoco-warp", "torch")}
(folder / "peer.json").write_text(json.dumps({"env_states_per_s": rate, "versions": versions}))
"""


def has_mjlab(python: str) -> bool:
    """Whether this interpreter can import mjlab."""
    try:
        return subprocess.run([python, "-c", "import mjlab"], capture_output=True).returncode == 0
    except OSError:
        return False


def peer_rate(
    python: str, task_name: str, *, num_envs: int, iterations: int, device: torch.device
) -> dict[str, Any]:
    """Train the peer's task in its own process, on the same device, and return env states/s and versions."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    index = device.index or 0
    gpu = "" if device.type == "cpu" else visible[index] if visible != [""] else str(index)
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    environment["CUDA_VISIBLE_DEVICES"] = gpu
    with tempfile.TemporaryDirectory() as folder:
        words = [TASKS[task_name], str(num_envs), str(iterations), folder]
        subprocess.run(
            [python, "-c", _PEER, *words], check=True, env=environment, stdout=subprocess.DEVNULL
        )
        return json.loads((Path(folder) / "peer.json").read_text())


def main() -> None:
    """Train both, print and write env states/s and their ratio."""
    parser = argparse.ArgumentParser(
        description="Training beside mjlab's, each in its own environment."
    )
    parser.add_argument("--python", help="the interpreter of an environment with mjlab and rsl_rl")
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument("overrides", nargs="*", metavar="OVERRIDE", help="as of `ksim-rl train`")
    options = parser.parse_intermixed_args()
    cfg = command_line.compose([*options.overrides, "logger=local", "trainer.eval_episodes=0"])
    if options.iterations < 4:
        raise ValueError(
            f"--iterations {options.iterations}: expected at least 4: the last half of them counts"
        )
    if options.python is None or not has_mjlab(options.python):
        print("no peer: give --python the interpreter of an environment with mjlab and rsl_rl")
        return
    if cfg.task_name not in TASKS:
        raise ValueError(f"task={cfg.task_name}: the peer has {', '.join(TASKS)}")
    device, iterations = cfg.resolved_device(), options.iterations
    peer = peer_rate(
        options.python, cfg.task_name, num_envs=cfg.num_envs, iterations=iterations, device=device
    )
    ours = 1000.0 * num_env_states(cfg) / train_ms(cfg, iterations=iterations)
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    figures = {
        "env_states_per_s": ours,
        "peer_env_states_per_s": peer["env_states_per_s"],
        "over_peer": ours / peer["env_states_per_s"],
    }
    for name, value in figures.items():
        print(f"{name} {value:,.4g}")
    path = report.write(
        "peers",
        figures={f"{prefix}/{name}": round(value, 4) for name, value in figures.items()},
        device=device,
        module="benchmarks.peers",
        peer_versions={prefix: peer["versions"]},
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
