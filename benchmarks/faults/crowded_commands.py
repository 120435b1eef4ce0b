"""Commands on a disk that is full at any file that they write, and two that make one table at the same time."""

from __future__ import annotations

import functools
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from benchmarks.faults import children, killed_commands, spread
from benchmarks.faults.file_operations import limit_files, no_space, on_each
from benchmarks.faults.killed_commands import COMMANDS, Command
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row

NEEDS_ROOM = ("open", "mkdir", "rename", "fsync")
SIZES = (0, 1000, 4000, 20000)  # bytes beyond which no file grows
WRITERS = ("export", "zoo add", "reproduce")
RESULT = "seed_1.json"


def _operations(command: Command, place: Path) -> int:
    """Count what a command does to files that needs room."""

    def say(kind: str, path: str) -> None:
        if kind in NEEDS_ROOM:
            os.write(1, b"@needs room\n")

    ended = killed_commands.start(command.words(place), before=lambda: on_each(place, say)).wait()
    if ended.code not in (0, 1):
        raise RuntimeError(f"exit code {ended.code}:\n{ended.text}")
    return ended.text.count("@needs room")


def _full_from(place: Path, at: int) -> None:
    """Let the disk be full from an operation on."""
    count = [0]

    def act(kind: str, path: str) -> None:
        if kind in NEEDS_ROOM:
            count[0] += 1
            if count[0] > at:
                raise no_space(path)

    on_each(place, act)


def full_disk_of_commands(
    folder: Path, *, points: int, sizes: int, commands: int, jobs: int = 1
) -> Figures:
    """Let the disk become full at operations of each command, and then be empty again."""
    trained = killed_commands.train_once(folder)
    cases = []
    for name in WRITERS[:commands]:
        counted = folder / name
        shutil.copytree(trained, counted)
        many = _operations(COMMANDS[name], counted)
        for at in range(0, many, max(1, many // points)):
            place = folder / f"{name} full at {at} of {many}"
            full = functools.partial(_full_from, place, at)
            cases.append(functools.partial(_fill, name, trained, place, full))
        for size in SIZES[:sizes]:
            place = folder / f"{name} with files of {size} bytes"
            limited = functools.partial(limit_files, size)
            cases.append(functools.partial(_fill, name, trained, place, limited))
    return spread.summed(cases, folder, jobs=jobs)


def _fill(name: str, trained: Path, place: Path, before: Callable[[], None]) -> dict[str, int]:
    shutil.copytree(trained, place)
    command = COMMANDS[name]
    words = command.words(place)
    ended = killed_commands.start(words, before=before).wait()
    # A table reports of rows that failed, and ends with 1 as one that was not reproduced does.
    clear = ended.code in (0, 1) or (ended.code in (2, 3) and "ksim-rl: error: " in ended.text)
    half = command.halves(place)
    after = killed_commands.start(command.again(place)).wait()
    goes_on = after.code in (0, 1)
    if not clear or half or not goes_on or ended.raw_traceback:
        print(f"{place.name}: exit code {ended.code}: {ended.text[-600:]}", flush=True)
        print(f"    then exit code {after.code}: {after.text[-600:]}", flush=True)
    shutil.rmtree(place)
    return {
        "cases": 1,
        "ended_badly": int(not clear),
        "half_files": half,
        "raw_tracebacks": int(ended.raw_traceback),
        "do_not_go_on": int(not goes_on),
    }


def two_tables(folder: Path, *, races: int) -> Figures:
    """Begin `reproduce` of one table twice at the same moment."""
    children.warm()
    found = {
        "races": 0,
        "ended_badly": 0,
        "results_absent": 0,
        "raw_tracebacks": 0,
        "done_twice": 0,
    }
    for number in range(races):
        place = folder / str(number)
        place.mkdir()
        words = COMMANDS["reproduce"].words(place)
        both = [killed_commands.start(words) for _ in range(2)]
        ended = [child.wait() for child in both]
        found["races"] += 1
        found["ended_badly"] += sum(one.code != 0 for one in ended)
        found["results_absent"] += not list((place / "out").rglob(RESULT))
        found["raw_tracebacks"] += sum(one.raw_traceback for one in ended)
        # The other one says that it was done by another process.
        found["done_twice"] += sum("seed 1: done\n" in one.text for one in ended) > 1
        for one in ended:
            if one.code != 0 or one.raw_traceback:
                print(f"exit code {one.code}: {one.text[-1000:]}", flush=True)
    return found


ROWS = {
    "full_disk_of_commands": Row(
        fault="a disk that becomes full at any file that export, zoo add and reproduce write; files that cannot grow",
        must="ended with a clear error; nothing half looks whole; with room again the command goes on",
        limits={
            "cases": (AT_LEAST, "least"),
            **dict.fromkeys(
                ("ended_badly", "half_files", "raw_tracebacks", "do_not_go_on"), (EXACTLY, 0)
            ),
        },
        measure=lambda folder, *, least, **amounts: full_disk_of_commands(folder, **amounts),
        amounts={"points": 8, "sizes": 4, "commands": 3, "least": 30},
        short={"points": 1, "sizes": 1, "commands": 1, "least": 2},
        splits=True,
        files=(
            "ksim_rl/files/writing.py",
            "ksim_rl/export",
            "ksim_rl/zoo/adding.py",
            "ksim_rl/tables",
        ),
    ),
    "two_tables": Row(
        fault="two processes reproduce one table at the same time",
        must="both end with exit code 0; each job is done once, and its result is there",
        limits={
            "races": (AT_LEAST, "races"),
            **dict.fromkeys(
                ("ended_badly", "results_absent", "raw_tracebacks", "done_twice"), (EXACTLY, 0)
            ),
        },
        measure=two_tables,
        amounts={"races": 4},
        short={"races": 1},
        files=("ksim_rl/tables/runner.py", "ksim_rl/runs/run_lock.py"),
    ),
}
