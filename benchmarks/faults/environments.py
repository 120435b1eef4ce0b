"""Starts commands where the environment lacks something, or holds what no library expects."""

from __future__ import annotations

import functools
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.faults import children, spread
from benchmarks.faults.hostile_folder import PROGRAM
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row

MIB = 2**20
# Variables of the user who measures: a case has its own or none.
LEFT_OUT = (
    "COLUMNS",
    "DISPLAY",
    "MUJOCO_GL",
    "WARP_CACHE_PATH",
    "XDG_CACHE_HOME",
    "OMP_NUM_THREADS",
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One environment.

    Attributes:
        variables: those that are set; None takes one away.
        limits: the most of a resource of `resource`, such as the address space in bytes.
        closed: file descriptors that are closed, as the shell's `>&-` does.
        full: whether what is printed goes to a disk that is full.
        gone: whether the working directory is deleted before the command begins.
    """

    variables: Mapping[str, str | None] = field(default_factory=dict)
    limits: Mapping[int, int] = field(default_factory=dict)
    closed: tuple[int, ...] = ()
    full: bool = False
    gone: bool = False


def _sized(name: str, kind: int, *sizes: int) -> dict[str, Case]:
    return {f"{name} of {size}": Case(limits={kind: size}) for size in sizes}


def _set(name: str, *values: str | None) -> dict[str, Case]:
    found = {}
    for value in values:
        shown = f"{name}={value}" if value is not None else f"no {name}"
        found[shown] = Case(variables={name: value})
    return found


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
CASES: dict[str, Case] = {
    **_sized("stack", resource.RLIMIT_STACK, 256 * 1024),
    **_sized("address space", resource.RLIMIT_AS, 300 * MIB, 600 * MIB, 1500 * MIB, 4000 * MIB),
    **_sized("memory", resource.RLIMIT_DATA, 50 * MIB, 400 * MIB),
    **_sized("open files", resource.RLIMIT_NOFILE, 6, 24),
    **_sized("files", resource.RLIMIT_FSIZE, 0, 1000),
    **_set("LC_ALL", "C", "xx_YY.UTF-8"),
    "locale C as ASCII": Case(variables=ASCII),
    **_set("PYTHONIOENCODING", "ascii"),
    **_set("HOME", None, "", "/dev/null", "relative"),
    **_set("TMPDIR", "/no/such", "/dev/null", "/proc"),
    **_set("PATH", None, "/no/such"),
    **_set("COLUMNS", "0", "1", "many"),
    **_set("TERM", None, "no_such"),
    **_set("PYTHONSTARTUP", "/no/such.py"),
    **_set("PYTHONWARNINGS", "error"),
    **_set("PYTHONOPTIMIZE", "2"),
    **_set("OMP_NUM_THREADS", "many"),
    **_set("CUDA_VISIBLE_DEVICES", "nonsense"),
    **_set("WORLD_SIZE", "many", "0", "-1", "2"),
    **_set("RANK", "5"),
    **_set("MPLBACKEND", "nonsense"),
    **_set("WARP_CACHE_PATH", "", "/proc/cache"),
    **_set("XDG_CACHE_HOME", "/dev/null"),
    **_set("TZ", "nonsense"),
    **_set("KSIM_RL_PLUGINS", "no_such_package", "../x"),
    **_set("KSIM_RL_PLUGIN_PATH", "/no/such"),
    "no standard input": Case(closed=(0,)),
    "no standard output": Case(closed=(1,)),
    "no standard error": Case(closed=(2,)),
    "no stream": Case(closed=(0, 1, 2)),
    "output on a full disk": Case(full=True),
    "no working directory": Case(gone=True),
    "nothing in the environment": Case(variables=dict.fromkeys(os.environ)),
}
TRAIN = ["train", *children.SMALLEST, "trainer.num_iterations=1", "trainer.eval_episodes=0"]


def start(case: Case, words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the command in this environment, in a folder of its own, and return how it ended."""
    variables = {name: value for name, value in os.environ.items() if name not in LEFT_OUT}
    for name, value in case.variables.items():
        variables.pop(name, None)
        if value is not None:
            variables[name] = value
    work = folder / "work"
    work.mkdir(parents=True)

    def prepare() -> None:
        for kind, most in case.limits.items():
            resource.setrlimit(kind, (most, most))
        if case.gone:
            work.rmdir()
        for number in case.closed:
            os.close(number)

    with open("/dev/full", "wb") as full:
        place = full if case.full else subprocess.PIPE
        return subprocess.run(
            [sys.executable, *PROGRAM, *words],
            env=variables,
            cwd=work,
            preexec_fn=prepare,
            stdin=subprocess.DEVNULL,
            stdout=place,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            timeout=1800,
        )


def wrong(case: Case, ended: subprocess.CompletedProcess[str]) -> str:
    """Return what is wrong with how a command ended, or nothing."""
    if "Traceback" in ended.stderr or "Exception ignored" in ended.stderr:
        return "a traceback"
    if ended.returncode in (0, 1):
        return ""
    if ended.returncode not in (2, 3):
        return f"exit code {ended.returncode}"
    lines = re.findall(r"^ksim-rl: (?:rank \d+: )?error: .*$", ended.stderr, re.MULTILINE)
    if len(lines) != 1 and 2 not in case.closed:
        return f"{len(lines)} lines of errors"
    return ""


def environments(
    folder: Path, *, cases: int, jobs: int = 1, note: Callable[[str], None] = print
) -> Figures:
    """Train the smallest task in each environment; count those that work, are refused in one line, or neither."""
    chosen = []
    for number, name in enumerate(list(CASES)[:cases]):
        chosen.append(functools.partial(_train_in, name, folder / str(number), note))
    return spread.summed(chosen, folder, jobs=jobs)


def _train_in(name: str, place: Path, note: Callable[[str], None]) -> dict[str, int]:
    ended = start(CASES[name], [*TRAIN, f"hydra.run.dir={place / 'run'}"], place)
    fault = wrong(CASES[name], ended)
    if fault:
        note(f"{name}: {fault}: exit code {ended.returncode}: {ended.stderr[-500:]}")
    works = ended.returncode in (0, 1)
    return {
        "cases": 1,
        "work": int(works and not fault),
        "one_line": int(not works and not fault),
        "neither": int(bool(fault)),
    }


ROWS = {
    "environments": Row(
        fault="limits of memory, files and stacks; other locales; no HOME, TMPDIR, PATH or working directory; closed "
        "streams, output on a full disk; variables of Python, torchrun and libraries that are nonsense",
        must="the command works, or one line names the cause, exit code 2 or 3; no crash and no traceback",
        limits={"cases": (AT_LEAST, "cases"), "neither": (EXACTLY, 0)},
        measure=environments,
        amounts={"cases": 50},
        short={"cases": 2},
        splits=True,
        files=("ksim_rl/cli/errors.py", "ksim_rl/cli/main.py", "ksim_rl/cli/process.py"),
    ),
}
