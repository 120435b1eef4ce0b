"""Signals in every phase of a run, a second process in a run folder, and a clock that jumps."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.faults import children
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row
from benchmarks.faults.saving import same_bits
from ksim_rl.runs import curves, run_lock
from ksim_rl.trainers import checkpoint, run_folder

FILES = (
    "ksim_rl/trainers/interrupt.py",
    "ksim_rl/trainers/trainer.py",
    "ksim_rl/cli/report.py",
    "ksim_rl/cli/errors.py",
)


def _phases() -> dict[str, tuple[Any, str, int]]:
    """Return for each phase whose first call the signal precedes, and how many iterations are saved at least."""
    _, trainer = children.warm()
    return {
        "building": (run_folder, "build", 0),
        "compiling": (trainer.collector, "collect", 1),
        "saving": (checkpoint, "_write_durably", 1),
        "evaluating": (trainer.evaluator, "_start", 2),
        "drawing": (curves, "draw", 3),
    }


def signals(folder: Path, *, phases: int) -> Figures:
    """Send SIGINT and SIGTERM in each phase, and a second signal after the first."""
    found = {
        "cases": 0,
        "exit_codes": 0,
        "said": 0,
        "true_words": 0,
        "leftovers": 0,
        "raw_tracebacks": 0,
    }
    for phase, (owner, name, least) in list(_phases().items())[:phases]:
        for number in (signal.SIGINT, signal.SIGTERM):
            for times in (1, 2):
                if times == 2 and phase in ("building", "drawing"):
                    continue  # the first one ends those at once
                run = folder / f"{phase}{number}x{times}"

                def send(number=number, times=times) -> None:
                    for _ in range(times):
                        os.kill(os.getpid(), number)

                def work(run=run, owner=owner, name=name, send=send) -> int:
                    if name == "build":
                        build = _warm_build_that(send)
                        return build(run)
                    children.before_first(owner, name, send)
                    return children.train(run)

                ended = children.start(work).wait()
                found["cases"] += 1
                found["exit_codes"] += ended.code == 128 + number
                found["said"] += (
                    f"{signal.Signals(number).name}: " in ended.text and "save" in ended.text
                )
                found["true_words"] += _true(ended.text, run, least if times == 1 else 0)
                found["leftovers"] += len(children.leftovers(run))
                found["raw_tracebacks"] += ended.raw_traceback
    return found


def _warm_build_that(send: Callable[[], None]) -> Callable[[Path], int]:
    """Return a run that is sent the signal while it is built: after the folder was made, before anything is in it."""

    def run(folder: Path) -> int:
        loading_notes = run_folder.loading_notes

        def sends(tree: Any) -> list[str]:
            send()
            return loading_notes(tree)

        run_folder.loading_notes = sends
        return children.train(folder)

    return run


def _true(text: str, run: Path, least: int) -> bool:
    """Whether what was said of the checkpoints is what is there."""
    saved = checkpoint.saved(run / "checkpoint")
    whole = [checkpoint.load(path).iteration for path in saved]
    if "continue with: ksim-rl resume" in text:
        return bool(whole) and max(whole) >= least
    if "no checkpoint is saved yet" in text:
        return not whole and run.exists() and least == 0
    return "nothing is saved, and no folder is left" in text and not run.exists()


def lock(folder: Path, *, races: int) -> Figures:
    """Let a second process write, read while one writes, kill the holder, and let several begin at once."""
    run = folder / "run"
    run.mkdir()

    def hold() -> int:
        with run_lock.locked(run, note=print):
            print("held", flush=True)
            time.sleep(600)
        return 0

    def second() -> int:
        return children.train(run, num_iterations=1)

    checkpoint.save(run / "checkpoint", {"x": 1}, iteration=1, config={})
    holder = children.start(hold)
    holder.read(until=b"held")
    known = json.loads((run / run_lock.LOCK).read_text())
    refused = children.start(second).wait()
    words = (str(holder.pid), known["host"], known["since"], "writes this run")
    lines = [line for line in refused.text.splitlines() if line.startswith("ksim-rl: error:")]
    figures: dict[str, float] = {
        "refused_with_2": refused.code == 2,
        "one_line_with_pid_host_time": len(lines) == 1 and all(word in lines[0] for word in words),
        "readers_go_on": checkpoint.load_latest(run).iteration == 1,
    }
    holder.kill()
    after = children.start(second).wait()
    figures["stale_taken_over_and_said"] = after.code in (0, 1) and "takes it over" in after.text
    figures["races"], figures["races_with_one_writer"] = races, 0
    for number in range(races):
        place = folder / f"race{number}"
        place.mkdir()

        def contend(place=place) -> int:
            try:
                with run_lock.locked(place, note=lambda _: None):
                    print("holds", flush=True)
                    time.sleep(600)
            except ValueError:
                print("refused", flush=True)
            return 0

        contenders = [children.start(contend) for _ in range(4)]
        said = sorted(child.read(until=b"\n").split()[0] for child in contenders)
        for child in contenders:
            child.kill()
        figures["races_with_one_writer"] += said == [b"holds", b"refused", b"refused", b"refused"]
    return {name: float(value) for name, value in figures.items()}


def clock(folder: Path) -> Figures:
    """Let the clock of the machine jump back and forth in each iteration; compare with a run whose clock does not."""
    steady, jumping = folder / "steady", folder / "jumping"
    children.start(lambda: children.train(steady)).wait()

    def jump() -> int:
        real, calls = time.time, []

        def jumps() -> float:
            calls.append(0)
            return real() + (-1) ** len(calls) * 3600.0 * 24 * 365 * (len(calls) % 7)

        time.time = jumps
        return children.train(jumping)

    ended = children.start(jump).wait()
    for age, path in enumerate(reversed(checkpoint.saved(jumping / "checkpoint"))):
        os.utime(path, (10**9 + age, 10**9 + age))
    one, other = (checkpoint.load_latest(run) for run in (steady, jumping))
    rows = [line.split(",") for line in (jumping / "metrics.csv").read_text().splitlines()]
    at = rows[0].index("seconds")
    seconds = [float(row[at]) for row in rows[1:]]
    return {
        "ended_well": ended.code in (0, 1) and not ended.raw_traceback,
        "differ": same_bits(one.state, other.state),
        "newest_taken": other.iteration == one.iteration,
        "seconds_that_do_not_rise": sum(
            b < a or a < 0 for a, b in zip(seconds, seconds[1:], strict=False)
        ),
    }


ROWS = {
    "signals": Row(
        fault="SIGINT and SIGTERM while building, compiling, saving, evaluating and drawing, and a second one",
        must="exit code 130 or 143; what is saved is said, and is there; no lock, half file or empty folder is left",
        limits={
            "cases": (AT_LEAST, "cases"),
            **dict.fromkeys(("exit_codes", "said", "true_words"), (AT_LEAST, "cases")),
            "leftovers": (EXACTLY, 0),
            "raw_tracebacks": (EXACTLY, 0),
        },
        measure=lambda folder, *, phases, cases: signals(folder, phases=phases),
        amounts={"phases": 5, "cases": 16},
        short={"phases": 2, "cases": 6},
        files=FILES,
    ),
    "lock": Row(
        fault="a second process writes a run folder; the first one is killed; four begin at once",
        must="refused in one line with pid, host and time, exit code 2; readers go on; a stale lock is taken",
        limits={
            "refused_with_2": (EXACTLY, 1),
            "one_line_with_pid_host_time": (EXACTLY, 1),
            "readers_go_on": (EXACTLY, 1),
            "stale_taken_over_and_said": (EXACTLY, 1),
            "races": (AT_LEAST, "races"),
            "races_with_one_writer": (AT_LEAST, "races"),
        },
        measure=lock,
        amounts={"races": 20},
        short={"races": 1},
        files=("ksim_rl/runs/run_lock.py",),
    ),
    "clock": Row(
        fault="the clock of the machine jumps by years between any two looks at it; times of files are upside down",
        must="the same weights; the newest checkpoint holds the last iteration; seconds of the run only rise",
        limits={
            "ended_well": (EXACTLY, 1),
            "differ": (EXACTLY, 0),
            "newest_taken": (EXACTLY, 1),
            "seconds_that_do_not_rise": (EXACTLY, 0),
        },
        measure=clock,
        files=("ksim_rl/trainers/progress.py", "ksim_rl/trainers/checkpoint.py"),
    ),
}
