"""Times the start of Python to the end of the first iteration, without and with caches.

    python -m benchmarks.first_iteration task=go1_velocity_flat num_envs=4096 device=cuda

takes the overrides of `ksim-rl train`. Two processes import what that imports, as it does, and run one iteration each,
one after the other, with caches of kernels and of Python's bytecode of their own that are empty at first. Figures go to
benchmarks/results/throughput.json: `first_iteration_cold_s` and `first_iteration_warm_s`.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time

from benchmarks import command_line, report

_CHILD = """
import sys, time
from ksim_rl.cli.main import gc_disabled
with gc_disabled():
    from ksim_rl import conf
    from ksim_rl.trainers import build
trainer = build(conf.compose(sys.argv[1:]))
trainer.iterate()
trainer.settle()
print(time.monotonic())
"""


def first_iteration_s(overrides: list[str], cache: str) -> float:
    """Return the seconds that a new process takes for one iteration, with its caches in the folder `cache`."""
    environment = os.environ | {"WARP_CACHE_PATH": cache, "TRITON_CACHE_DIR": f"{cache}/triton"}
    environment |= {
        "TORCHINDUCTOR_CACHE_DIR": f"{cache}/inductor",
        "CUDA_CACHE_PATH": f"{cache}/driver",
    }
    environment |= {"PYTHONPYCACHEPREFIX": f"{cache}/bytecode", "PYTHONDONTWRITEBYTECODE": ""}
    command, began = [sys.executable, "-c", _CHILD, *overrides], time.monotonic()
    said = subprocess.run(
        command, check=True, env=environment, stdout=subprocess.PIPE, text=True
    ).stdout
    # The clock of the machine: an exit frees memory for a while.
    return float(said.split()[-1]) - began


def main() -> None:
    """Measure both, print and write them."""
    overrides = [*sys.argv[1:], "logger=none", "trainer.eval_episodes=0"]
    cfg = command_line.compose(overrides)
    with tempfile.TemporaryDirectory() as cache:
        figures = {
            f"first_iteration_{state}_s": round(first_iteration_s(overrides, cache), 2)
            for state in ("cold", "warm")
        }
    device = cfg.resolved_device()
    prefix = f"{report.device_label(device)}/{cfg.task_name}/{cfg.num_envs}"
    for name, seconds in figures.items():
        print(f"{name} {seconds:.1f}")
    path = report.write(
        "throughput",
        figures={f"{prefix}/{name}": value for name, value in figures.items()},
        device=device,
        module="benchmarks.first_iteration",
    )
    print(f"written to {path}")


if __name__ == "__main__":
    command_line.run(main)
