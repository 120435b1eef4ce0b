"""A disk that is full at any file that a run writes, and a run folder that is deleted, moved or made read-only."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import yaml
from PIL import Image

from benchmarks.faults import children
from benchmarks.faults.file_operations import limit_files, no_space, on_each
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row
from ksim_rl.runs.csv_table import read_table
from ksim_rl.trainers import Trainer, checkpoint
from ksim_rl.trainers.checkpoint import CheckpointError

FILES = (
    "ksim_rl/files/writing.py",
    "ksim_rl/runs/watch.py",
    "ksim_rl/trainers/checkpoint.py",
    "ksim_rl/trainers/run_folder.py",
)
NEEDS_ROOM = ("open", "mkdir", "rename", "fsync")
# Words with which a run says that something could not be written.
SAYS = ("warning: ", "ksim-rl: error: ", "no learning curves")


def _operations(run: Path) -> list[str]:
    """Return what a run does to files, in order: kind and name."""

    def say(kind: str, path: str) -> None:
        os.write(1, f"@{kind} {Path(path).name}\n".encode())

    def work() -> int:
        on_each(run, say)
        return children.train(run)

    text = children.start(work).wait().text
    seen = [line[1:] for line in text.splitlines() if line.startswith("@")]
    return [line for line in seen if line.split()[0] in NEEDS_ROOM]


def disk_full(folder: Path, *, points: int, sizes: int) -> Figures:
    """Let the disk be full once, and from then on, at each operation of a run; and let no file grow beyond a size."""
    names = _operations(folder / "clean")
    every = max(1, len(names) // points)
    cases: list[tuple[str, Callable[[Path], None]]] = []
    for at in range(0, len(names), every):
        for lasts in (False, True):
            cases.append((names[at], lambda run, at=at, lasts=lasts: _fail(run, at, lasts)))
    limits = [0, 100, 1000, 4000, 8000, 12000, 20000, 40000][:: max(1, 8 // sizes)]
    cases += [(f"files of {size} bytes", lambda _, size=size: _limit(size)) for size in limits]
    found = {"cases": 0, "files": 0, "ended_badly": 0, "said": 0, "unloadable": 0, "half_files": 0}
    found |= {"raw_tracebacks": 0, "hangs": 0}
    for number, (_, harm) in enumerate(cases):
        run = folder / f"run{number}"

        def work(run=run, harm=harm) -> int:
            harm(run)
            return children.train(run)

        ended = children.start(work).wait()
        found["cases"] += 1
        clear = ended.code in (0, 1) or (ended.code == 3 and "ksim-rl: error: " in ended.text)
        found["ended_badly"] += not clear
        # A failure may be mended in silence: a second flush, or a file that is only opened again.
        found["said"] += any(word in ended.text for word in SAYS)
        found["unloadable"] += _unloadable(run)
        found["half_files"] += len(_half_files(run))
        found["raw_tracebacks"] += ended.raw_traceback
        found["hangs"] += "hangs: killed" in ended.text
        shutil.rmtree(run, ignore_errors=True)
    found["files"] = len({name.split()[-1].split(".")[0] for name, _ in cases})
    return found


def _limit(size: int) -> None:
    """Limit files from the first rollout on; torch makes a file of its own before."""
    _, trainer = children.warm()
    children.before_first(trainer.collector, "collect", lambda: limit_files(size))


def _fail(run: Path, at: int, lasts: bool) -> None:
    count = [0]

    def act(kind: str, path: str) -> None:
        if kind not in NEEDS_ROOM:
            return
        count[0] += 1
        if count[0] == at + 1 or (lasts and count[0] > at):
            raise no_space(path)

    on_each(run, act)


def _unloadable(run: Path) -> bool:
    """Whether there are checkpoints, and the latest does not load."""
    if not checkpoint.saved(run / "checkpoint"):
        return False
    try:
        checkpoint.load_latest(run, note=lambda _: None)
    except CheckpointError:
        return True
    return False


def _half_files(run: Path) -> list[str]:
    """Return files that look whole and are not."""

    def picture(path: Path) -> None:
        with Image.open(path) as image:
            image.load()

    readers: dict[str, Callable[[Path], object]] = {
        "config.yaml": lambda path: yaml.safe_load(path.read_text())["task_name"],
        "run.json": lambda path: json.loads(path.read_text())["sessions"],
        "evaluation.json": lambda path: json.loads(path.read_text())["return_mean"],
        "metrics.csv": lambda path: [float(row["iteration"]) for row in read_table(path)[1]],
        "curves.png": picture,
    }
    found = []
    for name, read in readers.items():
        try:
            if (run / name).exists():
                read(run / name)
        except Exception:
            found.append(name)
    return found


def _delete(run: Path) -> None:
    shutil.rmtree(run)


def _move(run: Path) -> None:
    run.rename(run.with_name(f"{run.name}_moved"))


def _empty(run: Path) -> None:
    for entry in list(run.iterdir()):
        if entry.name != ".lock":
            shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def _read_only(run: Path) -> None:
    """Let the folder answer as a disk that is mounted read-only does, which also stops an administrator."""
    access = os.access
    os.access = lambda path, mode, **options: (
        False
        if str(path).startswith(str(run)) and mode & os.W_OK
        else access(path, mode, **options)
    )

    def refuse(kind: str, path: str) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), path)

    on_each(run, refuse)


def folder_gone(folder: Path, *, cases: int) -> Figures:
    """Delete, move, empty and lock away a run folder in the middle of a run."""
    found = {
        "cases": 0,
        "exit_code_3": 0,
        "said_within_one_iteration": 0,
        "new_halves": 0,
        "unloadable": 0,
    }
    found["raw_tracebacks"] = 0
    for harm, word in (
        (_delete, "deleted or moved"),
        (_read_only, "read-only"),
        (_move, "deleted or moved"),
        (_empty, "deleted or moved"),
    )[:cases]:
        run = folder / harm.__name__

        def act(trainer: Trainer, harm=harm, run=run) -> None:
            print("@harm", flush=True)
            harm(run)

        ended = children.start(
            lambda run=run, act=act: children.train(
                run, hooks=(children.At(2, act),), num_iterations=6
            )
        ).wait()
        after = ended.text.partition("@harm")[2]
        later = after.partition(word)[0].count("\niteration ")
        found["cases"] += 1
        found["exit_code_3"] += ended.code == 3
        # The iteration of the fault has its line of figures after it where it is evaluated or saved.
        found["said_within_one_iteration"] += word in after and later <= 1
        halves = [path for path in run.rglob("*") if path.is_dir()] if run.exists() else []
        found["new_halves"] += bool(halves) if harm in (_delete, _move, _empty) else 0
        found["unloadable"] += _unloadable(run) or _unloadable(run.with_name(f"{run.name}_moved"))
        found["raw_tracebacks"] += ended.raw_traceback
    return found


ROWS = {
    "disk_full": Row(
        fault="a full disk at every file that a run opens, makes, renames or flushes, once or from then on; "
        "files that cannot grow beyond a size",
        must="the run goes on or ends with a clear error; the last checkpoint loads; nothing half looks whole",
        limits={
            "cases": (AT_LEAST, "least"),
            "ended_badly": (EXACTLY, 0),
            "unloadable": (EXACTLY, 0),
            "half_files": (EXACTLY, 0),
            "raw_tracebacks": (EXACTLY, 0),
            "hangs": (EXACTLY, 0),
        },
        measure=lambda folder, *, points, sizes, least: disk_full(
            folder, points=points, sizes=sizes
        ),
        amounts={"points": 1000, "sizes": 8, "least": 100},
        short={"points": 2, "sizes": 1, "least": 5},
        files=FILES,
    ),
    "folder_gone": Row(
        fault="the run folder is deleted, moved, emptied or made read-only while training",
        must="said within one iteration, exit code 3; no new half of a folder; what was moved still loads",
        limits={
            "cases": (AT_LEAST, "cases"),
            "exit_code_3": (AT_LEAST, "cases"),
            "said_within_one_iteration": (AT_LEAST, "cases"),
            "new_halves": (EXACTLY, 0),
            "unloadable": (EXACTLY, 0),
            "raw_tracebacks": (EXACTLY, 0),
        },
        measure=folder_gone,
        amounts={"cases": 4},
        short={"cases": 2},
        files=FILES,
    ),
}
