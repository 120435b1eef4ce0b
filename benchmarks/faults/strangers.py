"""These rows send what strangers may: payloads in run folders, pickles in data files, and malformed models."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row
from ksim_rl import conf


@contextlib.contextmanager
def _place(folder: Path, tree: dict) -> Iterator[Any]:
    """Make a stranger's run folder with places around it that nothing may touch, as the tests do."""
    from ksim_rl.cli import run_commands, train
    from ksim_rl.config import plugins
    from tests.cli.payloads import SECRET, Place, as_a_run_would

    for name in ("run", "outside", "work"):
        (folder / name).mkdir(parents=True)
    handlers = list(logging.root.handlers)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder / "work")
        patch.syspath_prepend(str(folder / "run"))
        patch.setenv("KSIM_RL_SECRET", SECRET)
        patch.delenv("KSIM_RL_MARK", raising=False)
        patch.setenv(plugins.VARIABLE, "")
        patch.setattr(plugins, "_named", [])
        patch.setattr(sys, "argv", list(sys.argv))
        for module in (train, run_commands):
            patch.setattr(module, "run_and_report", as_a_run_would)
        yield Place(run=folder / "run", outside=folder / "outside", tree=tree)
    logging.root.handlers[:] = handlers
    sys.modules.pop("stranger", None)


def payloads(folder: Path, *, families: int) -> Figures:
    """Write each family of payloads into a run folder, and call the command that reads it."""
    from tests.cli.payloads import FAMILIES, SMALL, call, signs

    tree = conf.compose(SMALL).to_tree()
    chosen = list(FAMILIES.items())[:: max(1, len(FAMILIES) // families)]
    found = {
        "families": 0,
        "executed_written_or_leaked": 0,
        "refused_in_one_line": 0,
        "files_written": 0,
    }
    for name, (write, _) in chosen:
        with _place(folder / name, tree) as place:
            command = write(place)
            before = _files(place.run.parent)
            said = io.StringIO()
            with contextlib.redirect_stderr(said):
                code = call(command)
            error = said.getvalue()
            found["families"] += 1
            found["executed_written_or_leaked"] += len(signs(place, error))
            one_line = error.startswith("ksim-rl: error: ") and error.count("\n") == 1
            found["refused_in_one_line"] += code == 2 and one_line
            found["files_written"] += len(_files(place.run.parent) - before)
    found["not_refused"] = found["families"] - found["refused_in_one_line"]
    return found


def _files(folder: Path) -> set[str]:
    return {str(path) for path in folder.rglob("*") if "__pycache__" not in str(path)}


def data_files(folder: Path) -> Figures:
    """Give motions and motor models that are pickles, pipes, devices, and longer than they may be."""
    from ksim_rl.files.reading import MOST_DATA_BYTES
    from tests.cli.test_foreign_files import DATA_FILES

    def pipe(path: Path, _code: str) -> None:
        os.mkfifo(path)

    def device(path: Path, _code: str) -> None:
        path.symlink_to("/dev/zero")

    def too_long(path: Path, _code: str) -> None:
        with open(path, "wb") as file:
            file.truncate(MOST_DATA_BYTES + 1)

    files = refused = 0
    mark = folder / "executed"
    for kind, (pickled, read, _) in DATA_FILES.items():
        writes: tuple[Callable[[Path, str], None], ...] = (pickled, pipe, device, too_long)
        for number, write in enumerate(writes):
            path = folder / f"{kind}{number}.npz"
            write(path, f"open({str(mark)!r}, 'w').close()")
            files += 1
            try:
                read(path)
            except ValueError as error:
                refused += str(path) in str(error)
    return {"files": files, "not_refused_by_name": files - refused, "executed": mark.exists()}


def small_files(folder: Path, *, files: int) -> Figures:
    """Read files that would hang a program or fill its memory, each in a process of its own."""
    from tests.files import bombs

    return bombs.figures(list(bombs.BOMBS)[:files], folder)


def control_codes(folder: Path) -> Figures:
    """Name folders by what a terminal obeys, and call the commands that say so."""
    from tests.cli.payloads import call
    from tests.test_terminal import COMMANDS, EVIL, OBEYED

    found = {"cases": 0, "obeyed_letters": 0, "not_one_line": 0}
    names = [os.fsencode(EVIL), b"\xff\xfe", b"a\nb\x7f"]
    for command in COMMANDS:
        for name in names:
            path = os.fsdecode(os.fsencode(folder) + b"/" + name)
            os.makedirs(path, exist_ok=True)
            said = io.StringIO()
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
                call([command, path, path] if command == "compare" else [command, path])
            found["cases"] += 1
            found["obeyed_letters"] += len(OBEYED & set(said.getvalue()))
            found["not_one_line"] += len(said.getvalue().splitlines()) != 1
    return found


# A model that MuJoCo compiles, and steps backwards.
TAKEN = "timestep is negative"


def models(folder: Path, *, kinds: int) -> Figures:
    """Load each kind of malformed model in a process of its own."""
    from tests.physics import malformed_kinds

    names = list(malformed_kinds.kinds())
    chosen = names
    if kinds < 150:
        # A few of all kinds of files, and one that MuJoCo itself takes.
        others = [name for name in names if name != TAKEN]
        chosen = [TAKEN, *others[:: -(-len(others) // (kinds - 1))]]
    found = malformed_kinds.figures(chosen)
    return {name: found[name] for name in ("kinds", "crashes", "hangs", "accepted")}


ROWS = {
    "payloads": Row(
        fault="payloads in every kind of file of a run folder: callbacks, resolvers, tags, pickles, links, packages",
        must="nothing executed, written or read from the environment; each refused in one line, exit code 2",
        limits={
            "families": (AT_LEAST, "families"),
            **dict.fromkeys(
                ("executed_written_or_leaked", "not_refused", "files_written"), (EXACTLY, 0)
            ),
        },
        measure=payloads,
        amounts={"families": 20},
        short={"families": 5},
        files=("ksim_rl/config", "ksim_rl/conf", "ksim_rl/cli", "tests/cli/payloads"),
    ),
    "data_files": Row(
        fault="motions and motor models that are pickles, pipes, devices, or without end",
        must="refused by name; nothing executed",
        limits={
            "files": (AT_LEAST, 8),
            "not_refused_by_name": (EXACTLY, 0),
            "executed": (EXACTLY, 0),
        },
        measure=data_files,
        files=(
            "ksim_rl/config/plain_data.py",
            "ksim_rl/scene/motions",
            "ksim_rl/scene/actuators/nets.py",
        ),
    ),
    "small_files": Row(
        fault="small files that claim much: YAML, tables, tensors, motions, recordings, and pipes, also for a lock",
        must="refused by name, or read, within 10 s and 1 GiB",
        limits={"files": (AT_LEAST, "files"), **dict.fromkeys(("crashes", "hangs"), (EXACTLY, 0))},
        measure=small_files,
        amounts={"files": 26},
        short={"files": 5},
        files=(
            "ksim_rl/files",
            "ksim_rl/config/plain_data.py",
            "ksim_rl/runs/csv_table.py",
            "ksim_rl/clips",
        ),
    ),
    "control_codes": Row(
        fault="names of files that hold ESC, its like, line ends, marks of direction, and bytes that are no UTF-8",
        must="one line, in which a terminal finds nothing to obey",
        limits={
            "cases": (AT_LEAST, 24),
            **dict.fromkeys(("obeyed_letters", "not_one_line"), (EXACTLY, 0)),
        },
        measure=control_codes,
        files=("ksim_rl/terminal.py", "ksim_rl/cli"),
    ),
    "models": Row(
        fault="malformed models, models with nonsensical numbers, and models that explode while they compile",
        must="no crash, no hang beyond 10 s, none accepted: one line with the file",
        limits={
            "kinds": (AT_LEAST, "kinds"),
            **dict.fromkeys(("crashes", "hangs", "accepted"), (EXACTLY, 0)),
        },
        measure=models,
        amounts={"kinds": 150},
        short={"kinds": 10},
        files=(
            "ksim_rl/physics/load.py",
            "ksim_rl/physics/model_checks.py",
            "ksim_rl/physics/model_size.py",
        ),
    ),
}
