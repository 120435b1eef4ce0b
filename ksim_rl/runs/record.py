"""A run folder says how its run came about: command line, code, versions, hardware, and how each session ended.

`run.json` has an entry per session: the first one, and one more for each time that the run was resumed. It is data:
entries of others are read as text. The environment's variables are never in it.
"""

import dataclasses
import json
import os
import platform
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

import torch

from ksim_rl.checked import Checked
from ksim_rl.config import plugins
from ksim_rl.config.child_processes import ask_git
from ksim_rl.files.reading import read_bytes
from ksim_rl.files.writing import write_whole
from ksim_rl.runs.run_lock import is_locked
from ksim_rl.terminal import printable

RECORD = "run.json"
Status = Literal["running", "done", "interrupted", "failed"]
# The packages that numbers depend on; their versions are compared when runs differ.
PACKAGES = [
    "ksim_rl",
    "torch",
    "torchrl",
    "tensordict",
    "mujoco",
    "mujoco-warp",
    "warp-lang",
    "triton",
    "numpy",
    "hydra-core",
    "omegaconf",
]
# A file that a stranger or a loop of restarts has filled stays small.
MOST_SESSIONS = 1000
MOST_DIFF_BYTES = MOST_RECORD_BYTES = 4 * 2**20


@dataclass(frozen=True, kw_only=True)
class Session(Checked):
    """One time that a run was started or resumed; `code` has the commit of each package and its changes since."""

    began: str
    command: str
    code: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    hardware: Mapping[str, str] = field(default_factory=dict)
    status: Status = "running"
    why: str = ""
    ended: str = ""


@contextmanager
def recorded(
    folder: Path, *, command: Sequence[str] | None = None, note: Callable[[str], None]
) -> Iterator[Callable[[Status, str], None]]:
    """Add a session to the record of a folder while this process writes there, with "failed" where the block raises.

    The block is given a function that says how it ended and why. The command is by default this process's own.
    """
    began = f"{datetime.now():%Y-%m-%d %H:%M:%S}"
    # A damaged record must not keep a run from starting.
    try:
        earlier = read(folder)[-MOST_SESSIONS + 1 :]
    except ValueError as error:
        note(f"warning: {error}; it starts over")
        earlier = []
    session = Session(
        began=began,
        # Quoted, so that it can be pasted into a shell.
        command=shlex.join(sys.argv if command is None else command),
        code=_code(folder, len(earlier) + 1),
        versions=versions(),
        hardware=hardware(),
    )

    # The whole file each time: it is small, and never half written.
    def ended(status: Status, why: str) -> None:
        now = f"{datetime.now():%Y-%m-%d %H:%M:%S}"
        _write(folder, [*earlier, dataclasses.replace(session, status=status, why=why, ended=now)])

    _write(folder, [*earlier, session])
    try:
        yield ended
    except BaseException as error:
        why = f"{type(error).__name__}: {error}"
        with suppress(OSError):  # a folder that is gone or full; the error says so
            ended("interrupted" if isinstance(error, KeyboardInterrupt) else "failed", why)
        raise


def read(folder: Path) -> list[Session]:
    """Return the sessions of a run, none where nothing was recorded; a ValueError where the file holds other things."""
    path = folder / RECORD
    # Also a broken link counts as there, and is refused below.
    if not os.path.lexists(path):
        return []
    try:
        entries = json.loads(read_bytes(path, limit=MOST_RECORD_BYTES))["sessions"]
        # Fields are checked as in configs; unknown ones raise TypeError.
        sessions = [Session(**_text(entry)) for entry in entries[:MOST_SESSIONS]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: no record of a run: {printable(str(error))}") from error
    return sessions


def status(folder: Path) -> tuple[str, str]:
    """Return how a run stands, a `Status` or "unknown", and why; a process that was killed has failed."""
    # The lock shows a living process, which the record cannot.
    if is_locked(folder):
        return "running", ""
    try:
        sessions = read(folder)
    except ValueError as error:
        return "unknown", str(error)
    if not sessions:
        return "unknown", "of an earlier version"
    last = sessions[-1]
    # No end was written, and no process holds the lock.
    if last.status == "running":
        return "failed", "its process ended without a word: killed, or the machine went down"
    return last.status, last.why


def _text(value: Any) -> Any:
    # Control characters of a stranger's file must not reach the terminal.
    if isinstance(value, dict):
        return {printable(str(name)): _text(entry) for name, entry in value.items()}
    if isinstance(value, str):
        return printable(value)
    return value


def _write(folder: Path, sessions: Sequence[Session]) -> None:
    tree = {"sessions": [dataclasses.asdict(session) for session in sessions]}
    write_whole(folder / RECORD, json.dumps(tree, indent=2) + "\n")


def _code(folder: Path, session: int) -> dict[str, dict[str, str]]:
    """Return the commits of this package, the plug-ins and the program, and write the changes since then beside them.

    Only these are asked: a repository somewhere around the working directory may be anybody's.
    """
    found: dict[str, dict[str, str]] = {}
    # Packages of one repository are listed once.
    seen = set()
    for name in ("ksim_rl", *sorted(plugins.packages()), "__main__"):
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or not (repository := _repository(Path(file))) or repository[1] in seen:
            continue
        commit, top = repository
        seen.add(top)
        found[name] = {"commit": commit}
        # No programs of the repository's settings run: neither diff tools nor converters of text.
        if changes := ask_git(top, "diff", "--no-ext-diff", "--no-textconv", "--no-color", "HEAD"):
            # Each session keeps its own changes: the code may have changed in between.
            if session == 1:
                kept = f"{name}.diff"
            else:
                kept = f"{name}.{session}.diff"
            # A large diff is most often data; the commit alone is kept then.
            if len(changes) <= MOST_DIFF_BYTES:
                write_whole(folder / kept, changes)
            if len(changes) <= MOST_DIFF_BYTES:
                found[name]["changed"] = kept
            else:
                found[name]["changed"] = "too much to keep"
        # Files that git does not know are named, not copied.
        if new := ask_git(
            top, "ls-files", "--others", "--exclude-standard", "--exclude=__pycache__"
        ):
            found[name]["not in git"] = ", ".join(new.decode(errors="replace").splitlines()[:20])
    return found


def _repository(file: Path) -> tuple[str, Path] | None:
    """Return the commit and the top folder of the repository that has a file, and not only lies around it."""
    # A site-packages folder inside of some repository is no part of it.
    if ask_git(file.parent, "ls-files", "--error-unmatch", "--", file.name) is None:
        return None
    answer = ask_git(file.parent, "rev-parse", "HEAD", "--show-toplevel")
    if answer is None:  # nothing is committed yet
        return None
    commit, top = answer.decode().splitlines()
    return commit, Path(top)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a run depends on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def hardware() -> dict[str, str]:
    """Return facts about this machine: host, system, cores, memory, processor, GPUs."""
    found = {"host": platform.node(), "system": platform.platform(), "cores": str(os.cpu_count())}
    # Bytes of all pages.
    found["memory"] = f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    # Linux only; elsewhere the kind of processor is left out.
    processors = Path("/proc/cpuinfo")
    if processors.exists():
        models = (
            line.split(":", 1)[1].strip()
            for line in processors.read_text().splitlines()
            if "model name" in line
        )
        found["processor"] = next(models, platform.machine())
    for index in range(torch.cuda.device_count()):
        about = torch.cuda.get_device_properties(index)
        found[f"gpu {index}"] = f"{about.name}, {about.total_memory / 2**30:.0f} GiB"
    return found
