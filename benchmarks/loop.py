"""Measures how punctual the loop of an exported folder is while all cores are busy, and whether its memory grows.

    python -m benchmarks.loop --minutes 30
    python -m benchmarks.loop --minutes 3 --policy zoo:go1

A policy is exported, and its `loop.py` runs on the simulated robot, with one process that only counts on each core. A
period begins at its deadline. Own jitter is how much longer than the median it took from the moment when the system let
the loop run until the command was handed to the robot; physics of the simulation come behind that. How late the system
let it run is another figure. Figures go to benchmarks/results/loop.json, once with real-time priority, if the system
grants it, and once without, for a tenth of the time. The watchdog waits for 2 s here, so that the measurement goes on
where a shared machine stands still; how often it would have struck by default is reported.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from benchmarks import report
from ksim_rl.checks import OneLineParser
from ksim_rl.export import export_policy
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.run_folder import policy_of
from ksim_rl.zoo.sources import locate

LATE_PERIODS = "100"
MOST_JITTER_MS = 1.0
MOST_GROWTH_MIB = 1.0
SHORT_SHARE = 0.1
COUNTS = "number = 0\nwhile True:\n    number += 1\n"


def main() -> int:
    """Run the loop twice, and write its own report; the exit code is 1 beyond 1 ms or where memory grows."""
    parser = OneLineParser(prog="python -m benchmarks.loop", description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0, help="of the policy")
    parser.add_argument("--policy", default="zoo:quadruped", help="a run, or one of the zoo")
    options: Any = parser.parse_args()
    seconds = 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as temporary:
        saved = checkpoint.load_latest(locate(options.policy))
        folder = export_policy(
            policy_of(saved, device="cpu"), Path(temporary) / "export", episodes=0
        )
        busy = _occupy_cores()
        try:
            first = run_loop(folder, seconds, Path(temporary), "first")
            second = run_loop(
                folder, SHORT_SHARE * seconds, Path(temporary), "second", "--no-real-time"
            )
        finally:
            for process in busy:
                process.kill()
                process.wait()
    growth_mib = first["memory_mib_last"] - first["memory_mib_early"]
    print(
        f"own jitter {first['own_jitter_ms_p99']:.3f} ms (99 %), memory grew by {growth_mib:.2f} MiB"
    )
    path = report.write(
        "loop",
        figures={
            "own_jitter_ms_p99": first["own_jitter_ms_p99"],
            "woken_late_ms_p99": first["woken_late_ms_p99"],
            "sent_after_deadline_ms_p99": first["sent_after_deadline_ms_p99"],
            "missed_periods": first["missed_periods"],
            "three_periods_late": first["three_periods_late"],
            "memory_growth_mib": growth_mib,
            "without_priority/own_jitter_ms_p99": second["own_jitter_ms_p99"],
            "without_priority/woken_late_ms_p99": second["woken_late_ms_p99"],
            "without_priority/sent_after_deadline_ms_p99": second["sent_after_deadline_ms_p99"],
        },
        device=torch.device("cpu"),
        module="benchmarks.loop",
        policy=options.policy,
        minutes=options.minutes,
        busy_cores=len(busy),
        load=os.getloadavg()[0],
        details={"first": first, "without_priority": second},
    )
    print(f"written to {path}")
    fault = bool(first["fault"] or second["fault"])
    late = first["own_jitter_ms_p99"] > MOST_JITTER_MS
    return int(fault or late or growth_mib > MOST_GROWTH_MIB)


def run_loop(folder: Path, seconds: float, files: Path, name: str, *words: str) -> dict[str, Any]:
    """Run the loop of an exported folder, and return its report."""
    output = files / f"{name}.json"
    done = subprocess.run(
        [
            *(sys.executable, str(folder / "loop.py"), "--simulate", "--seconds", str(seconds)),
            *("--log", str(files / f"{name}.csv"), "--report", str(output), *words),
            *("--late-periods", LATE_PERIODS),
        ],
        check=False,
    )
    if not output.exists():
        raise SystemExit(f"loop.py ended with {done.returncode}")
    return json.loads(output.read_text())


def _occupy_cores() -> list[subprocess.Popen[bytes]]:
    """Start a process on each core that only counts."""
    cores = len(os.sched_getaffinity(0))
    return [subprocess.Popen([sys.executable, "-c", COUNTS]) for _ in range(cores)]


if __name__ == "__main__":
    sys.exit(main())
