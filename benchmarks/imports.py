"""Times what an import of a room costs beyond the packages that it is made for.

    python -m benchmarks.imports

Each room is imported in new processes, after TorchRL, or for the engine after torch, MuJoCo Warp and Warp. Figures are
medians of the processor's time, which other programs of the machine do not lengthen, and go to
benchmarks/results/imports.json, beside the time of TorchRL itself.
"""

import statistics
import subprocess
import sys

import torch

from benchmarks import report

RUNS = 5
TORCHRL = "import torchrl.data, torchrl.envs, torchrl.modules, torchrl.objectives"
SIMULATION = "import torch, mujoco_warp, warp"
# Each is imported alone: the others would bring half of it.
ROOMS = {
    "transforms": TORCHRL,
    "objectives": TORCHRL,
    "modules": TORCHRL,
    "data": TORCHRL,
    "physics": SIMULATION,
}
_CHILD = """
import time
{first}
began = time.process_time()
import {room}
print(time.process_time() - began)
"""


def import_s(room: str, first: str) -> float:
    """Return the seconds of the processor for one import in a new process, once `first` has run there."""
    program = _CHILD.format(room=room, first=first)
    done = subprocess.run(
        [sys.executable, "-c", program], check=True, stdout=subprocess.PIPE, text=True
    )
    return float(done.stdout.split()[-1])


def main() -> None:
    """Measure all rooms in turn, print and write them."""
    given = {"torchrl": ("torchrl.data, torchrl.envs, torchrl.modules, torchrl.objectives", "pass")}
    given |= {room: (f"ksim_rl.{room}", first) for room, first in ROOMS.items()}
    found: dict[str, list[float]] = {name: [] for name in given}
    for _ in range(RUNS):
        for name, (room, first) in given.items():
            found[name].append(import_s(room, first))
    figures = {}
    for name, seconds in found.items():
        median = statistics.median(seconds)
        figures[f"cpu/{name}_s"] = round(median, 2)
        print(f"{name} {median:.2f} s")
    path = report.write(
        "imports", figures=figures, device=torch.device("cpu"), module="benchmarks.imports"
    )
    print(f"written to {path}")


if __name__ == "__main__":
    main()
