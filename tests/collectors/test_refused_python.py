"""Python that a call changes, and Python that asks the host, is refused by name while a step is recorded."""

import itertools
import os
import random
import time
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from ksim_rl.envs.recorded_python import FrozenPythonError
from tests.collectors.recorded_puck import Calling, Constant, collector_of, rewards_of

CALLS = 0
SEEN: list[int] = []


@dataclass(frozen=True, kw_only=True)
class Counter(Constant):
    calls: int = 0

    def value(self):
        object.__setattr__(self, "calls", self.calls + 1)
        return self.calls > 20


@dataclass(kw_only=True, unsafe_hash=True, frozen=True)
class OwnList(Constant):
    seen: list = field(default_factory=list, hash=False)

    def value(self):
        self.seen.append(1)
        return len(self.seen)


class OwnClassAttribute(Constant):
    count = 0

    def value(self):
        type(self).count += 1
        return self.count


class GlobalCounter(Constant):
    def value(self):
        global CALLS
        CALLS += 1
        return CALLS


class GlobalList(Constant):
    def value(self):
        SEEN.append(1)
        return len(SEEN)


def counting():
    count = 0

    def count_on():
        nonlocal count
        count += 1
        return count

    return count_on


class MutableDefault(Constant):
    def value(self, memory=[]):  # noqa: B006
        memory.append(1)
        return len(memory)


class OfView(Constant):
    """Keeps its count where other terms may look for it."""

    def __call__(self, view):
        view.count = getattr(view, "count", 0) + 1
        return torch.full((view.num_envs,), float(view.count))


class WallClock(Constant):
    def value(self):
        return time.time() % 100.0


class Today(Constant):
    def value(self):
        return datetime.now().second


class PythonRandom(Constant):
    def value(self):
        return random.uniform(0.0, 1.0)


class NumpyRandom(Constant):
    def value(self):
        return np.random.rand()


class Environment(Constant):
    def value(self):
        return float(os.environ.get("PUCK_SCALE", "1"))


@dataclass(frozen=True, kw_only=True)
class FromFile(Constant):
    path: Path = Path()

    def value(self):
        return float(self.path.read_text())


def one_after_the_other():
    yield from range(10_000)


REFUSED = {
    "a counter of the term": (lambda: Counter(), r"rewards\.term\.calls was \d+ and is \d+"),
    "a list of the term": (lambda: OwnList(), r"rewards\.term\.seen\[\d+\] was \(absent\) and is 1"),
    "a counter of its class": (lambda: OwnClassAttribute(), r"rewards\.term: OwnClassAttribute\.count was"),
    "a global counter": (lambda: GlobalCounter(), r"rewards\.term: .*global .*CALLS was"),
    "a global list": (lambda: GlobalList(), r"rewards\.term: .*global .*SEEN\[\d+\] was"),
    "a closure": (lambda: Calling(ask=counting()), r"rewards\.term\.ask: count in the closure of"),
    "a generator": (lambda: Calling(ask=one_after_the_other().__next__), r"rewards\.term\.ask"),
    "an iterator": (lambda: Calling(ask=itertools.count().__next__), r"rewards\.term\.ask\.place was"),
    "a default argument": (lambda: MutableDefault(), r"rewards\.term: .*defaults of .*value"),
    "an attribute of the view": (lambda: OfView(), r"view\.count was \d+ and is \d+"),
    "a wall clock": (lambda: WallClock(), r"rewards\.term asks for a clock, by time\.time at test_refused_python"),
    "a date": (lambda: Today(), r"rewards\.term asks for a clock, by datetime\.now"),
    "random": (lambda: PythonRandom(), r"rewards\.term asks for random numbers .*, by Random\.random"),
    "numpy.random": (lambda: NumpyRandom(), r"rewards\.term asks for random numbers .*, by numpy\.random"),
    "a generator of numpy": (
        lambda: Calling(ask=np.random.default_rng(0).random),
        r"rewards\.term\.ask\.state is another object|rewards\.term\.ask\.state was",
    ),
    "a generator of random": (lambda: Calling(ask=random.Random(0).random), r"rewards\.term"),
    "the environment": (lambda: Environment(), r"rewards\.term asks for an environment variable"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_python_that_changes_from_step_to_step_is_refused_by_name(kind):
    make, message = REFUSED[kind]
    collector = collector_of(rewards={"term": make()})
    with pytest.raises(FrozenPythonError, match=message) as refusal:
        collector.collect()
    assert "collector.eager=true" in str(refusal.value)


def test_a_file_that_a_term_reads_is_refused_by_name(tmp_path):
    path = tmp_path / "scale"
    path.write_text("2.0")
    with pytest.raises(FrozenPythonError, match=r"rewards\.term asks for a file, by io\.open"):
        collector_of(rewards={"term": FromFile(path=path)}).collect()


@pytest.mark.parametrize("kind", ["a counter of the term", "a closure", "random", "a wall clock"])
def test_with_eager_the_python_of_each_step_runs(kind):
    make, _ = REFUSED[kind]
    collector = collector_of(rewards={"term": make()}, eager=True)
    means = rewards_of(collector, 8)
    assert len(set(means)) > 1
