"""Puts mended faults back, one by one, and says which generated model shows each.

    python -m benchmarks.judge.put_back [FAULT ...]

A fault is put back by leaving out what mends it, or by writing a line of C++ as it was. It is found if a model differs
from C then, or cannot be built, and does neither without the fault.
"""

import itertools
import math
import re
import sys
from contextlib import nullcontext
from dataclasses import dataclass

import mujoco
import warp as wp

from benchmarks.judge.comparison import Finding
from benchmarks.judge.faults import FAULTS, Fault, put_back
from benchmarks.judge.generator import Generated, generate
from benchmarks.judge.hunt import MOST_SECONDS
from benchmarks.judge.trial import Kernels, judge
from benchmarks.judge.workers import in_processes

SEED = 0
# How many models of a hunt are looked through for one that has what a fault needs, and how many of these are run.
LOOKED_AT, TRIED = 1500, 12


def suits(fault: Fault, found: Generated) -> bool:
    """Whether a model has what a fault needs."""
    if not found.features.issuperset(fault.needs) or re.search(fault.written, found.xml) is None:
        return False
    return fault.suits is None or fault.suits(mujoco.MjModel.from_xml_string(found.xml))


@dataclass(frozen=True, kw_only=True)
class Try:
    """A model that is judged.

    Args:
        fault: the name of the fault that it may show.
        number: of the model in the hunt.
        is_put_back: whether the fault is there.
    """

    fault: str
    number: int
    is_put_back: bool


def tried(task: Try) -> tuple[Finding, ...]:
    """Return what differs from C in a model, with a fault or without it."""
    # Most of the time goes into compiling kernels, which run for an instant.
    wp.config.optimization_level = 0
    fault = FAULTS[task.fault]
    found = generate(SEED, task.number)
    with put_back(fault) if task.is_put_back else nullcontext():
        return _findings(found, fault.kernels)


def _findings(found: Generated, kernels: Kernels) -> tuple[Finding, ...]:
    forces = "forces" in found.features
    try:
        verdict = judge(
            found.xml, fields=found.fields, kernels=kernels, forces=forces, seed=found.number
        )
    except Exception as error:
        return (_failure(f"{type(error).__name__}: {error}"),)
    return (_failure(verdict.refused),) if verdict.refused else verdict.findings


def _failure(what: str) -> Finding:
    """Say what ended a model before anything could be compared."""
    return Finding(quantity=what, error=float("inf"), limit=0.0, world=0, when="")


def shown_by(name: str) -> tuple[int, Finding] | None:
    """Return the number of a model that shows a fault, and what differs in it; None where none of those tried does."""
    fault = FAULTS[name]
    suitable = (number for number in range(LOOKED_AT) if suits(fault, generate(SEED, number)))
    tasks = []
    for number in itertools.islice(suitable, TRIED):
        tasks.append(Try(fault=name, number=number, is_put_back=False))
        tasks.append(Try(fault=name, number=number, is_put_back=True))
    is_right = False
    # In a process of its own, which a fault may end.
    for task, result in in_processes(tried, tasks, jobs=1, most_seconds=MOST_SECONDS):
        differing = (_failure(str(result)),) if isinstance(result, RuntimeError) else result
        if not task.is_put_back:
            is_right = not differing
        elif is_right and differing:
            return task.number, differing[0]
    return None


def main(names: list[str]) -> int:
    """Print a row for each fault, and return 1 if one is not found."""
    missed = 0
    for name in names or list(FAULTS):
        fault = FAULTS[name]
        shown = shown_by(name)
        if shown is None:
            missed += 1
            print(f"| {fault.number} | {name} | {fault.what} | not found |", flush=True)
            continue
        number, finding = shown
        how = f"`{finding.quantity}` {finding.error:.2g} apart, allowed {finding.limit:.2g}"
        if math.isinf(finding.error):
            how = finding.quantity
        print(f"| {fault.number} | {name} | {fault.what} | model {number}: {how} |", flush=True)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
