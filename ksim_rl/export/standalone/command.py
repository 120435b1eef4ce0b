"""Runs an exported policy on MuJoCo's C engine; it needs numpy, onnxruntime and mujoco, and nothing else.

    python runner.py [DIR] --episodes 100 --output result.json

In a program of yours: `runner = Runner(DIR)`, `runner.reset()`, then `runner.step(runner.act())` at each env step.
`export.json` says what the ONNX files read; names, not numbers, say which joint is which. All files are
data: nothing in them is executed, and none may lead out of the folder.
"""

import argparse
import json
import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np

from ksim_rl.export.standalone.files import Array, as_text, check_parent, read_arrays, read_json
from ksim_rl.export.standalone.models import check_record
from ksim_rl.export.standalone.runner import Runner
from ksim_rl.export.standalone.signals import INTEGRATORS

# Recorded starts, commands and pushes, which an export writes beside the model.
RECORD = "episodes.npz"
_own: list[Any] = []


def _begin(folder: str, seed: int, integrator: str, refine: int) -> None:
    runner = Runner(folder, seed)
    runner.change_physics(integrator, refine)
    _own[:] = [runner, _record(runner), seed]


def _record(runner: Runner) -> dict[str, Array]:
    path = runner.folder / RECORD
    record = read_arrays(path)
    check_record(path, record, runner.meta, runner.model)
    return record


def _run(number: int) -> dict[str, float]:
    runner, record, seed = _own
    # One stream per episode: the number of processes changes nothing.
    runner.draws = np.random.default_rng([seed, number])
    return runner.episode(record, number % len(record["start/qpos"]))


def _replay(runner: Runner, path: Path) -> None:
    record = read_arrays(runner.folder / "trace.npz")
    found = {"dt": np.array(runner.model.opt.timestep), "decimation": np.array(runner.decimation)}
    laws = runner.meta["actuators"]
    joint = runner.model.joint
    pairs = [pair for law in laws for pair in zip(law["joints"], law["actuators"], strict=True)]
    drives = [joint(int(runner.model.actuator(name).trnid[0])).name for _, name in pairs]
    found["crossed"] = np.array([own != d for (own, _), d in zip(pairs, drives, strict=True)], bool)
    for lag in range(1 + max((delay.most for delay in runner.lags), default=0)):
        for number in range(len(record["trace/done"])):
            replayed = runner.replay(record, number, lag)
            found |= {f"{lag}/{number}/{name}": value for name, value in replayed.items()}
    np.savez_compressed(path, **found)  # pyright: ignore[reportArgumentType]


def main() -> None:
    """Run episodes on all cores, and print or write their figures as JSON."""
    parser = argparse.ArgumentParser(description="Run an exported policy on MuJoCo's C engine.")
    parser.add_argument("folder", nargs="?", default=str(Path(__file__).parent))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of noise and lags")
    parser.add_argument(
        "--integrator", choices=INTEGRATORS, default="", help="default: the model's own"
    )
    parser.add_argument("--refine", type=int, default=1, help="so many substeps in place of one")
    parser.add_argument("--output", help="a JSON file; without it the means are printed")
    parser.add_argument(
        "--replay", help="an .npz file for what each recorded step of trace.npz gives here"
    )
    options = parser.parse_args()
    try:
        found = _run_all(options)
    except BrokenProcessPool:
        sys.exit(_refused("a process that ran episodes has crashed, or was killed for its memory"))
    except ValueError as error:
        sys.exit(_refused(str(error)))
    except Exception as error:  # whatever a stranger's file makes a library raise
        sys.exit(_refused(f"{options.folder}: {type(error).__name__}: {error}"))
    if options.output:
        Path(options.output).write_text(json.dumps(found))
        return
    print(as_text(found, read_json(Path(options.folder) / "export.json")))


def _check_options(options: argparse.Namespace) -> None:
    """Refuse wrong arguments now, before they fail in another process or after the last episode."""
    for name, least in (("episodes", 1), ("refine", 1), ("seed", 0)):
        value = getattr(options, name)
        if value < least:
            raise ValueError(f"--{name} {value}: expected at least {least}")
    for name in ("output", "replay"):
        path = getattr(options, name)
        if path:
            check_parent(f"--{name}", Path(path))


def _run_all(options: argparse.Namespace) -> list[dict[str, float]]:
    _check_options(options)
    # Errors are reported here: a child process that fails as it begins cannot report them.
    runner = Runner(options.folder, options.seed)
    _record(runner)
    if options.replay:
        _replay(runner, Path(options.replay))
    cores = min(len(os.sched_getaffinity(0)), options.episodes)
    arguments = (options.folder, options.seed, options.integrator, options.refine)
    with ProcessPoolExecutor(
        cores, multiprocessing.get_context("spawn"), _begin, arguments
    ) as pool:
        return list(pool.map(_run, range(options.episodes)))


def _refused(why: str) -> int:
    print(f"runner.py: error: {' '.join(why.split())}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()
