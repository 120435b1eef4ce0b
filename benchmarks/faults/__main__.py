"""Provoke faults, and write what happened into benchmarks/results/faults.json and docs/reliability.md.

    python -m benchmarks.faults [ROW ...] [form=short]

Without names all rows of this machine are measured; those of a GPU are left out where there is none, and are never
counted as passed then. The short form, which CI runs, prints what it found and writes nothing. Exit code 1: a limit is
broken.
"""

from __future__ import annotations

import sys
import tempfile
import time
import traceback
from pathlib import Path

import torch

from benchmarks import command_line
from benchmarks.faults import page
from benchmarks.faults.rows import ROWS
from ksim_rl.checks import check_choice


def main() -> int:
    """Measure the rows, print and write what was found."""
    options, wanted = command_line.split(sys.argv[1:], {"form": "long"})
    check_choice("form", options["form"], ("long", "short"))
    for name in wanted:
        check_choice("row", name, ROWS)
    short, holds = options["form"] == "short", True
    for name in wanted or list(ROWS):
        row = ROWS[name]
        if row.device == "cuda" and not torch.cuda.is_available():
            print(f"{name}: not measured: no CUDA device", flush=True)
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            try:
                figures, broken = row.run(Path(folder), short=short)
            except Exception as error:  # a row that cannot be measured is a row that fails
                traceback.print_exc()
                figures, broken = {}, [f"{type(error).__name__}: {error}"]
        seconds = time.monotonic() - began
        holds = holds and not broken
        shown = ", ".join(f"{figure} {value:g}" for figure, value in figures.items())
        print(f"{name}: {'FAILS' if broken else 'passes'} in {seconds:.0f} s: {shown}", flush=True)
        for line in broken:
            print(f"    {line}", flush=True)
        if not short:
            page.write_row(name, figures, passed=not broken)
    return 0 if holds else 1


if __name__ == "__main__":
    command_line.run(main)
