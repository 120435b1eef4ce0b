"""Whole commands are killed at random moments, begun again, and what they left is looked at in between."""

from __future__ import annotations

import functools
import json
import random
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.faults import children, spread
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row
from ksim_rl.cli.main import main
from ksim_rl.files.writing import WRITING
from ksim_rl.runs import record
from ksim_rl.runs.run_lock import LOCK
from ksim_rl.trainers import checkpoint
from ksim_rl.trainers.checkpoint import CheckpointError
from ksim_rl.zoo.cards import hashes, read_card

# A commit that a zoo takes: the tree in which this runs may have changes.
COMMIT = {"ksim_rl": {"commit": "0" * 40}}
ENTRY = "pole"
TABLE = """\
name: killed
title: A table that is killed
groups: {ppo: {objective: ppo, env_states: 1.0e+3, seeds: [1], rows: {One: {task: cartpole_balance}}}}
"""
# A command that is never alive at the moment of its kill would be tried for ever.
MOST_TRIES = 4
# A table says nothing while it waits for the job of a process that was killed, and then does its own.
MOST_SILENT_S = 900


@dataclass(frozen=True, kw_only=True)
class Command:
    """What is killed: its words, what they are once it was killed, and what of its folder is half, by its `place`."""

    words: Callable[[Path], Sequence[str]]
    again: Callable[[Path], Sequence[str]]
    halves: Callable[[Path], int]


def _whole_run(place: Path) -> int:
    """Count checkpoints that do not load, and a config that is cut."""
    run = place / "run"
    half = 0
    for path in checkpoint.saved(run / "checkpoint"):
        try:
            checkpoint.load(path)
        except CheckpointError:
            half += 1
    if (run / "config.yaml").exists():
        half += "task_name" not in (run / "config.yaml").read_text()
    return half + _cut_json(run)


def _cut_json(folder: Path) -> int:
    half = 0
    for path in folder.rglob("*.json"):
        # Files that are being written have names of their own, and count as nothing.
        if WRITING in str(path.relative_to(folder)):
            continue
        try:
            json.loads(path.read_text())
        except ValueError:
            half += 1
    return half


def _whole_zoo(place: Path) -> int:
    entry = place / "zoo" / ENTRY
    if not entry.exists():
        return 0
    card = read_card(ENTRY, place / "zoo")
    return int(card.files != hashes(entry))


def _train(place: Path) -> list[str]:
    return [
        "train",
        *children.SMALLEST,
        "trainer.num_iterations=20",
        f"hydra.run.dir={place / 'run'}",
    ]


def _train_again(place: Path) -> list[str]:
    if checkpoint.saved(place / "run" / "checkpoint"):
        return ["resume", str(place / "run")]
    return _train(place)


def _resume(place: Path) -> list[str]:
    return ["resume", str(place / "run"), "--num-iterations", "20"]


def _eval(place: Path) -> list[str]:
    return ["eval", str(place / "run"), "--episodes", "50", "--device", "cpu"]


def _export(place: Path) -> list[str]:
    return ["export", str(place / "run"), "--episodes", "2"]


def _zoo_add(place: Path) -> list[str]:
    return [
        "zoo",
        "add",
        str(place / "run"),
        ENTRY,
        "--folder",
        str(place / "zoo"),
        "--episodes",
        "2",
    ]


def _zoo_again(place: Path) -> list[str]:
    if (place / "zoo" / ENTRY).exists():
        return ["zoo", ENTRY, "--folder", str(place / "zoo")]
    return _zoo_add(place)


def _reproduce(place: Path) -> list[str]:
    table = place / "table.yaml"
    table.write_text(TABLE)
    words = ["reproduce", str(table), "--smoke", "--device", "cpu"]
    return [*words, "--output", str(place / "out"), "--runs", str(place / "runs")]


COMMANDS = {
    "train": Command(words=_train, again=_train_again, halves=_whole_run),
    "resume": Command(words=_resume, again=_resume, halves=_whole_run),
    "eval": Command(words=_eval, again=_eval, halves=_whole_run),
    "export": Command(words=_export, again=_export, halves=_whole_run),
    "zoo add": Command(words=_zoo_add, again=_zoo_again, halves=_whole_zoo),
    "reproduce": Command(words=_reproduce, again=_reproduce, halves=_cut_json),
}


def start(words: Sequence[str], *, before: Callable[[], None] | None = None) -> children.Child:
    """Start a command in a child, as `ksim-rl` does, where `before` has happened."""

    def work() -> int:
        # Asking git about a tree with changes would let no zoo take its runs.
        record._code = lambda *_: COMMIT
        if before is not None:
            before()
        try:
            main(words)
        except SystemExit as ended:
            return int(ended.code or 0)
        raise AssertionError("a command always exits")

    return children.start(work, hangs_s=MOST_SILENT_S)


def _run(words: Sequence[str], *, kill_after: float | None = None) -> children.Ended:
    """Run a command, and kill it after some seconds."""
    child = start(words)
    if kill_after is None:
        return child.wait()
    children.pause(kill_after)
    return child.kill()


def train_once(folder: Path) -> Path:
    """Train the smallest task in `folder`/trained, and return that folder."""
    children.warm()
    trained = folder / "trained"
    ended = _run(["train", *children.SMALLEST, f"hydra.run.dir={trained / 'run'}"])
    if ended.code not in (0, 1):
        raise RuntimeError(f"training ended with exit code {ended.code}:\n{ended.text}")
    return trained


def killed_commands(folder: Path, *, kills: int, commands: int, jobs: int = 1) -> Figures:
    """Kill commands at random moments, begin each again, and count what is half, and what does not end well."""
    trained = train_once(folder)
    names = list(COMMANDS)[:commands]
    cases = []
    # The parts of a command stand apart, so that no process has two of the command that takes longest.
    for part in range(max(1, jobs // len(names))):
        for number, name in enumerate(names):
            share = _share(kills, among=len(names), number=number)
            here = _share(share, among=max(1, jobs // len(names)), number=part)
            place = folder / f"{name} {part}"
            cases.append(functools.partial(_kill, name, trained, place, kills=here))
    return spread.summed(cases, folder, jobs=jobs)


def _share(whole: int, *, among: int, number: int) -> int:
    return whole // among + (number < whole % among)


def _kill(name: str, trained: Path, folder: Path, *, kills: int) -> dict[str, int]:
    """Kill one command so often, each time in a copy of a folder with a trained run, or for `train` without it."""
    command = COMMANDS[name]
    choose = random.Random(f"{folder.name} {kills}")
    found = {"kills": 0, "corrupt": 0, "do_not_go_on": 0, "stray": 0, "raw_tracebacks": 0}
    _copy(trained, folder, of=name)
    began = time.monotonic()
    _run(command.words(folder))
    whole_s = time.monotonic() - began
    tries = 0
    while found["kills"] < kills and tries < MOST_TRIES * kills:
        tries += 1
        _copy(trained, folder, of=name)
        moment = choose.uniform(0.0, whole_s)
        ended = _run(command.words(folder), kill_after=moment)
        if ended.code >= 0:
            # It took less than when its time was taken, with caches that were cold.
            whole_s = moment
            continue
        found["kills"] += 1
        found["corrupt"] += command.halves(folder)
        after = _run(command.again(folder))
        if after.code not in (0, 1):
            print(f"{name}: exit code {after.code} after a kill:\n{after.text[-1000:]}", flush=True)
            found["do_not_go_on"] += 1
        found["raw_tracebacks"] += after.raw_traceback
        found["corrupt"] += command.halves(folder)
        left = _stray(folder)
        found["stray"] += len(left)
        for path in left:
            print(f"{name}: left after a kill: {path.relative_to(folder)}", flush=True)
    shutil.rmtree(folder)
    return {**found, f"kills_of_{name.replace(' ', '_')}": found["kills"]}


def _stray(folder: Path) -> list[Path]:
    """Return the files that a command which went on should have removed."""
    left = list(folder.rglob(f"{WRITING}*"))
    for lock in folder.rglob(LOCK):
        run = lock.parent
        # A run that was killed before its first checkpoint begins again beside its folder, into which no one writes
        # any more.
        if not run.with_name(f"{run.name}_2").exists():
            left.append(lock)
    return left


def _copy(trained: Path, folder: Path, *, of: str) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    if of == "train":
        folder.mkdir()
    else:
        shutil.copytree(trained, folder)


ROWS = {
    "killed_commands": Row(
        fault="kill -9 of train, resume, eval, export, zoo add and reproduce at random moments from their start on",
        must="nothing is corrupt; the command goes on when it is begun again, and then nothing stray is left",
        limits={
            "kills": (AT_LEAST, "kills"),
            **dict.fromkeys(("corrupt", "do_not_go_on", "stray", "raw_tracebacks"), (EXACTLY, 0)),
        },
        measure=killed_commands,
        amounts={"kills": 102, "commands": 6},
        short={"kills": 3, "commands": 1},
        splits=True,
        files=(
            "ksim_rl/files/writing.py",
            "ksim_rl/runs/run_lock.py",
            "ksim_rl/tables/runner.py",
            "ksim_rl/zoo/adding.py",
        ),
    ),
}
