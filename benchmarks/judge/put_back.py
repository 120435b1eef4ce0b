"""This command puts faults that are mended back, one by one, and says which generated model shows each.

    python -m benchmarks.judge.put_back [FAULT ...]

A fault is put back by leaving out what mends it. It is found if a model differs from C then, and not without it.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import warp as wp

from benchmarks.judge.comparison import Finding
from benchmarks.judge.generator import Generated, generate
from benchmarks.judge.trial import Kernels, judge

PHYSICS = "ksim_rl.physics"
SEED = 0
# How many models of a hunt are looked through for one that has what a fault needs, and how many of these are run.
LOOKED_AT, TRIED = 1500, 6


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault, and how it is put back.

    Args:
        what: it does.
        place: the module under `physics` and the name there of what mends it.
        instead: what stands there while it is put back.
        needs: the features that a model needs for it, all of them.
        kernels: by which it shows.
    """

    what: str
    place: tuple[str, str]
    instead: Any
    needs: tuple[str, ...]
    kernels: Kernels = "our solver"


def nothing(*given: Any, **named: Any) -> None:
    """Do nothing, and give nothing."""


def no(*given: Any, **named: Any) -> bool:
    """Say no."""
    return False


def none_of_them(*given: Any, **named: Any) -> list[int]:
    """Give an empty list."""
    return []


def as_it_is(integrate: Any, warp_data_E: Any) -> Any:
    """Give an integrator as it is."""
    return integrate


FAULTS = {
    "fixed geoms": Fault(
        what="geoms that are fixed to the world stay where the model has them",
        place=("substeps", "placing_of_fixed_geoms"),
        instead=nothing,
        needs=("field.geom_pos", "static_body"),
    ),
    "distances of boxes": Fault(
        what="sensors of distances read nothing of boxes that do not touch",
        place=("contacts", "take_over_measured_boxes"),
        instead=nothing,
        needs=("sensor.distance", "geom.box"),
    ),
    "ties": Fault(
        what="rows of connect and weld weigh other bodies than those that they tie",
        place=("substeps", "weighing_of_ties"),
        instead=nothing,
        needs=("equality.weld_world", "tool"),
    ),
    "pairs": Fault(
        what="two pairs of the same geoms count as one",
        place=("upstream", "take_pairs_as_written"),
        instead=nothing,
        needs=("pair_twice", "tree.free"),
    ),
    "second limits": Fault(
        what="a joint between two near limits has a row for one of them",
        place=("substeps", "adding_of_second_limits"),
        instead=nothing,
        needs=("narrow_limit",),
    ),
    "disabled actuators": Fault(
        what="actuators of disabled groups act",
        place=("warp_world", "switch_off"),
        instead=nothing,
        needs=("actuatorgroupdisable", "transmission.joint", "actuator.position"),
    ),
    "armature of actuators": Fault(
        what="worlds have the model's armature of actuators",
        place=("warp_world", "let_actuators_add"),
        instead=nothing,
        needs=("field.actuator_armature", "actuator_armature"),
    ),
    "sensors of contacts": Fault(
        what="contact sensors have another order, and touch no cutoff",
        place=("substeps", "mend_sensors"),
        instead=none_of_them,
        needs=("reduce.none", "tree.free", "sensor.contact"),
    ),
    "adhesion of actuators": Fault(
        what="actuators that adhere share their force with pairs that a sensor measures",
        place=("substeps", "miscounts_contacts"),
        instead=no,
        needs=("transmission.body", "sensor.distance"),
    ),
    "adhesion of geoms": Fault(
        what="geoms stick through sensors of distances",
        place=("contacts", "loose_contacts"),
        instead=nothing,
        needs=("geom_adhesion", "sensor.distance"),
    ),
    "sleep": Fault(
        what="where trees may sleep, a substep reads the state after it",
        place=("integration.integrators", "_keeping_readings"),
        instead=as_it_is,
        needs=("enable.sleep", "integrator.Euler", "damping"),
    ),
}


@contextmanager
def put_back(fault: Fault) -> Iterator[None]:
    """Leave out what mends a fault."""
    module, name = importlib.import_module(f"{PHYSICS}.{fault.place[0]}"), fault.place[1]
    mends = vars(module)[name]
    setattr(module, name, fault.instead)
    try:
        yield
    finally:
        setattr(module, name, mends)


def findings(found: Generated, kernels: Kernels) -> tuple[Finding, ...]:
    """Return what differs from C in a model."""
    forces = "forces" in found.features
    return judge(found.xml, fields=found.fields, kernels=kernels, forces=forces, seed=found.number).findings


def shown_by(fault: Fault) -> tuple[int, Finding] | None:
    """Return the number of a model that shows a fault, and what differs in it; None where none of those tried does."""
    tried = 0
    for number in range(LOOKED_AT):
        found = generate(SEED, number)
        if not found.features.issuperset(fault.needs):
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
            print(f"| {name} | {fault.what} | not found |", flush=True)
            continue
        number, finding = shown
        print(
            f"| {name} | {fault.what} | model {number}: `{finding.quantity}` {finding.error:.2g} apart, allowed "
            f"{finding.limit:.2g} |",
            flush=True,
        )
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
