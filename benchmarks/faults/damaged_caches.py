"""The caches of compilers hold files that are cut, empty or something else, such as a full disk or a copy leaves."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.faults import children
from benchmarks.faults.compile_once import has_triton
from benchmarks.faults.hostile_folder import PROGRAM
from benchmarks.faults.row import AT_LEAST, EXACTLY, Figures, Row

TRAIN = ("train", *children.SMALLEST, "trainer.num_iterations=1", "trainer.eval_episodes=0")
ONCE = ("-m", "benchmarks.faults.compile_once")


@dataclass(frozen=True, kw_only=True)
class Compiler:
    """A compiler: what moves its cache, the words of a program that uses it, and which files of the cache it reads."""

    variable: str
    words: Sequence[str]
    patterns: Sequence[str]


def _compilers(output: Path) -> dict[str, Compiler]:
    found = {}
    if has_triton():
        found["Triton"] = Compiler(
            variable="TRITON_CACHE_DIR",
            words=(*ONCE, "triton"),
            patterns=("twice.json", "__grp__*.json"),
        )
    found["torch.compile"] = Compiler(
        variable="TORCHINDUCTOR_CACHE_DIR",
        words=(*ONCE, "torch"),
        patterns=("*.py", "*.so", "fxgraph/*/*/*", "aotautograd/*/*"),
    )
    found["Warp"] = Compiler(
        variable="WARP_CACHE_PATH",
        words=(*PROGRAM, *TRAIN, f"hydra.run.dir={output}"),
        patterns=("*.o", "*.meta"),
    )
    return found


def _cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def _empty(path: Path) -> None:
    os.truncate(path, 0)


def _other(path: Path) -> None:
    path.write_bytes(bytes(range(256)))


DAMAGES: tuple[Callable[[Path], None], ...] = (_cut, _empty, _other)


def _run(compiler: Compiler, cache: Path, output: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, compiler.variable: str(cache)}
    shutil.rmtree(output, ignore_errors=True)
    return subprocess.run(
        [sys.executable, *compiler.words],
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
    )


def _cases(
    folder: Path,
) -> Iterator[tuple[str, Compiler, Path, list[tuple[Path, Callable[[Path], None]]]]]:
    """Fill the cache of each compiler, and give what can be damaged in it: a file of each kind, in each way."""
    for name, compiler in _compilers(folder / "run").items():
        cache = folder / name
        first = _run(compiler, cache, folder / "run")
        if first.returncode not in (0, 1):
            raise RuntimeError(
                f"{name} ended with exit code {first.returncode}:\n{first.stderr[-2000:]}"
            )
        damages = []
        for pattern in compiler.patterns:
            files = sorted(path for path in cache.rglob(pattern) if path.is_file())
            if not files:
                raise RuntimeError(f"{name}: no file {pattern} in its cache")
            damages += [(files[0], damage) for damage in DAMAGES]
        yield name, compiler, cache, damages


def damaged_caches(folder: Path, *, damages: int) -> Figures:
    """Damage one file of a cache at a time, and let its compiler read it."""
    found = {"damages": 0, "work": 0, "named_in_one_line": 0, "neither": 0}
    for name, compiler, cache, possible in _cases(folder):
        # Names of files in a cache may be absolute: it is damaged where it was made.
        whole = folder / "whole"
        shutil.copytree(cache, whole)
        for path, damage in possible:
            if found["damages"] == damages:
                return found
            damage(path)
            ended = _run(compiler, cache, folder / "run")
            fault = _wrong(ended, compiler, cache)
            found["damages"] += 1
            found["work"] += ended.returncode in (0, 1) and not fault
            found["named_in_one_line"] += ended.returncode not in (0, 1) and not fault
            found["neither"] += bool(fault)
            if fault:
                print(
                    f"{name}: {path.name} {damage.__name__}: {fault}: {ended.stderr[-800:]}",
                    flush=True,
                )
            shutil.rmtree(cache)
            shutil.copytree(whole, cache)
        shutil.rmtree(whole)
    return found


def _wrong(ended: subprocess.CompletedProcess[str], compiler: Compiler, cache: Path) -> str:
    """Return what is wrong with how a program ended, or nothing: it worked, or one line names the cache and the fix."""
    if ended.returncode in (0, 1):
        return ""
    lines = [line for line in ended.stderr.splitlines() if line.startswith("ksim-rl: error: ")]
    if ended.returncode != 3 or len(lines) != 1:
        return f"exit code {ended.returncode}, {len(lines)} lines of errors"
    if str(cache) not in lines[0] or compiler.variable not in lines[0]:
        return "the line does not name the cache and its variable"
    return ""


ROWS = {
    "damaged_caches": Row(
        fault="files in the caches of Warp, Triton and torch's compiler are cut, empty or something else, one by one",
        must="compiled again, with the right values, or one line that names the cache and the fix, exit code 3",
        limits={"damages": (AT_LEAST, "least"), "neither": (EXACTLY, 0)},
        measure=lambda folder, *, damages, least: damaged_caches(folder, damages=damages),
        # Without Triton, which comes with torch for CUDA, there are 6 fewer.
        amounts={"damages": 100, "least": 18},
        short={"damages": 1, "least": 1},
        files=(
            "ksim_rl/cli/errors.py",
            "ksim_rl/device/compiler_caches.py",
            "ksim_rl/device/kernel_cache.py",
        ),
    ),
}
