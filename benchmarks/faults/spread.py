"""Cases that do not depend on each other are spread over processes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.faults import children
from benchmarks.faults.row import Figures

Case = Callable[[], Figures]
# A process says nothing while its cases hold.
MOST_SILENT_S = 24 * 3600


def summed(cases: Sequence[Case], folder: Path, *, jobs: int) -> Figures:
    """Run cases in so many processes, forked warm, and return the sums of their figures.

    Args:
        cases: what counts something; each has files of its own.
        folder: where the processes leave what they counted.
        jobs: how many processes; with 1, all cases run in this one.

    Raises:
        RuntimeError: with what a process printed, if it ended before its cases did.
    """
    if jobs == 1:
        return _one_after_another(cases)
    workers = []
    for number in range(min(jobs, len(cases))):
        counted = folder / f"counted_{number}.json"
        share = cases[number::jobs]
        child = children.start(_worker(share, counted), hangs_s=MOST_SILENT_S)
        workers.append((child, counted))
    found = []
    for child, counted in workers:
        ended = child.wait()
        if ended.code:
            raise RuntimeError(f"exit code {ended.code} of a process with cases:\n{ended.text}")
        print(ended.text, end="", flush=True)
        found.append(json.loads(counted.read_text()))
    return _sum(found)


def _worker(cases: Sequence[Case], counted: Path) -> Callable[[], int]:
    def work() -> int:
        counted.write_text(json.dumps(_one_after_another(cases)))
        return 0

    return work


def _one_after_another(cases: Sequence[Case]) -> Figures:
    return _sum([case() for case in cases])


def _sum(found: Sequence[Figures]) -> Figures:
    total: dict[str, float] = {}
    for figures in found:
        for name, value in figures.items():
            total[name] = total.get(name, 0) + value
    return total
