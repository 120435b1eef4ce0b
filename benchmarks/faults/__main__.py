"""Provoke faults, and write what happened into benchmarks/results/faults.json and docs/reliability.md.

    python -m benchmarks.faults [ROW ...] [form=short] [jobs=N]
    python -m benchmarks.faults merge=FOLDER

Without names all rows of this machine are measured; without a GPU, rows that need one are left out and never count as
passed. `jobs` is how many rows run side by side, each in a process of its own, the soak first; rows that use the GPU
have it for themselves, last. A row that is named alone spreads its cases over so many processes, if it can.
The short form, which CI runs, prints what it found and writes nothing. With BENCHMARK_RESULTS=FOLDER results are
written there and the page is left alone; `merge` takes them from there. Exit code 1: a limit is broken.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import torch

from benchmarks import command_line
from benchmarks.faults import page
from benchmarks.faults.rows import ROWS
from ksim_rl.checks import check_choice


def main() -> int:
    """Measure the rows, print and write what was found."""
    options, wanted = command_line.split(sys.argv[1:], {"form": "long", "jobs": "1", "merge": ""})
    check_choice("form", options["form"], ("long", "short"))
    jobs = command_line.whole_number("jobs", options["jobs"])
    for name in wanted:
        check_choice("row", name, ROWS)
    if options["merge"]:
        page.merge([Path(options["merge"])])
        return 0
    short = options["form"] == "short"
    here = []
    for name in wanted or list(ROWS):
        if ROWS[name].device == "cuda" and not torch.cuda.is_available():
            print(f"{name}: not measured: no CUDA device", flush=True)
        else:
            here.append(name)
    if jobs == 1 or len(here) == 1:
        held = [_measure(name, short=short, jobs=jobs) for name in here]
    else:
        held = [ended == 0 for ended in _apart(here, form=options["form"], jobs=jobs)]
    return 0 if all(held) else 1


def _measure(name: str, *, short: bool, jobs: int) -> bool:
    """Measure a row, print it, write its long form; return whether it holds."""
    began, used = time.monotonic(), sum(os.times()[:4])
    with tempfile.TemporaryDirectory() as folder:
        try:
            figures, broken = ROWS[name].run(Path(folder), short=short, jobs=jobs)
        except Exception as error:  # a row that cannot be measured is a row that fails
            traceback.print_exc()
            figures, broken = {}, [f"{type(error).__name__}: {error}"]
    seconds, used = time.monotonic() - began, sum(os.times()[:4]) - used
    shown = ", ".join(f"{figure} {value:g}" for figure, value in figures.items())
    print(
        f"{name}: {'FAILS' if broken else 'passes'} in {seconds:.0f} s ({used:.0f} s of CPU): {shown}",
        flush=True,
    )
    for line in broken:
        print(f"    {line}", flush=True)
    if not short:
        page.write_row(name, figures, passed=not broken)
    return not broken


def _apart(names: Sequence[str], *, form: str, jobs: int) -> Iterator[int]:
    """Measure rows in processes of their own; merge what each one wrote when it ends, and give its exit code."""
    with tempfile.TemporaryDirectory() as folder:

        def measure(name: str) -> tuple[Path, subprocess.CompletedProcess[str]]:
            results = Path(folder) / name
            environment = os.environ | {"BENCHMARK_RESULTS": str(results)}
            if ROWS[name].device == "cpu":
                environment["CUDA_VISIBLE_DEVICES"] = ""
            command = [sys.executable, "-m", "benchmarks.faults", name, f"form={form}"]
            return results, subprocess.run(
                command,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )

        on_cpu = sorted(
            (name for name in names if ROWS[name].device == "cpu"), key=lambda name: name != "soak"
        )
        for count, group in ((jobs, on_cpu), (1, [name for name in names if name not in on_cpu])):
            with ThreadPoolExecutor(count) as pool:
                for row in as_completed([pool.submit(measure, name) for name in group]):
                    results, ended = row.result()
                    print(ended.stdout, end="", flush=True)
                    if ended.returncode not in (0, 1):
                        print(
                            f"{results.name}: FAILS: ended with exit code {ended.returncode}",
                            flush=True,
                        )
                    if (results / "faults.json").exists():
                        page.merge([results])
                    yield ended.returncode


if __name__ == "__main__":
    command_line.run(main)
