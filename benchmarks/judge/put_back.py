"""This command puts faults that are mended back, one by one, and says which generated model shows each.

    python -m benchmarks.judge.put_back [FAULT ...]

A fault is put back by leaving out what mends it, or by writing a line of C++ as it was. It is found if a model differs
from C then, or cannot be built, and does neither without the fault.
"""

import re
import sys

import warp as wp

from benchmarks.judge.comparison import Finding
from benchmarks.judge.faults import FAULTS, Fault, put_back
from benchmarks.judge.generator import Generated, generate
from benchmarks.judge.trial import Kernels, judge

SEED = 0
# How many models of a hunt are looked through for one that has what a fault needs, and how many of these are run.
LOOKED_AT, TRIED = 1500, 12


def suits(fault: Fault, found: Generated) -> bool:
    """Whether a model has what a fault needs."""
    return found.features.issuperset(fault.needs) and re.search(fault.written, found.xml) is not None


def findings(found: Generated, kernels: Kernels) -> tuple[Finding, ...]:
    """Return what differs from C in a model."""
    forces = "forces" in found.features
    try:
        verdict = judge(
            found.xml, fields=found.fields, kernels=kernels, forces=forces, seed=found.number, device="cpu"
        )
    except Exception as error:
        return (Finding(quantity=type(error).__name__, error=1.0, limit=0.0, world=0, when=str(error)),)
    if verdict.refused:
        return (Finding(quantity="refused", error=1.0, limit=0.0, world=0, when=verdict.refused),)
    return verdict.findings


def shown_by(fault: Fault) -> tuple[int, Finding] | None:
    """Return the number of a model that shows a fault, and what differs in it; None where none of those tried does."""
    tried = 0
    for number in range(LOOKED_AT):
        found = generate(SEED, number)
        if not suits(fault, found):
            continue
        with put_back(fault):
            differing = findings(found, fault.kernels)
        if differing and not findings(found, fault.kernels):
            return number, differing[0]
        tried += 1
        if tried == TRIED:
            return None
    return None


def main(names: list[str]) -> int:
    """Print a row for each fault, and return 1 if one is not found."""
    wp.config.optimization_level = 0
    missed = 0
    for name in names or list(FAULTS):
        fault = FAULTS[name]
        shown = shown_by(fault)
        if shown is None:
            missed += 1
            print(f"| {fault.number} | {name} | {fault.what} | not found |", flush=True)
            continue
        number, finding = shown
        print(
            f"| {fault.number} | {name} | {fault.what} | model {number}: `{finding.quantity}` {finding.error:.2g} "
            f"apart, allowed {finding.limit:.2g} |",
            flush=True,
        )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
