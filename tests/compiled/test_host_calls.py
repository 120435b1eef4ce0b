"""What a step asks the host for is found, with who asks; what libraries ask for themselves is not."""

import cProfile
import os
import random
import sys
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import torch

from ksim_rl.compiled.host_calls import CLOCK, ENVIRONMENT, FILE, RANDOM, host_calls


@dataclass(frozen=True)
class Part:
    """Calls what it was given."""

    ask: object

    def __call__(self):
        return self.ask()


def helper():
    return time.perf_counter()


ASKED = {
    "time": (lambda: time.monotonic(), CLOCK),
    "through a function": (helper, CLOCK),
    "date": (lambda: date.today(), CLOCK),
    "random": (lambda: random.gauss(0.0, 1.0), RANDOM),
    "own random": (lambda: random.Random(0).random(), RANDOM),
    "numpy": (lambda: np.random.normal(), RANDOM),
    "urandom": (lambda: os.urandom(3), RANDOM),
    "open": (lambda: open(__file__).close(), FILE),
    "stat": (lambda: Path(__file__).exists(), FILE),
    "environment": (lambda: os.environ.get("HOME"), ENVIRONMENT),
}


@pytest.mark.parametrize("name", ASKED)
def test_a_call_is_ascribed_to_the_part_that_makes_it(name):
    ask, what = ASKED[name]
    asking, quiet = Part(ask), Part(lambda: torch.randn(3).sum())
    with host_calls({"quiet": quiet, "rewards.asking": asking}) as calls:
        quiet()
        asking()
    assert {(call.part, call.what) for call in calls} == {("rewards.asking", what)}
    assert all(call.place.startswith("test_host_calls.py:") for call in calls)


def test_a_part_that_calls_another_one_is_not_blamed_for_it():
    inner = Part(lambda: np.random.rand())
    outer = Part(lambda: inner())
    with host_calls({"outer": outer, "inner": inner}) as calls:
        outer()
    assert [call.part for call in calls] == ["inner"]


def test_code_that_is_no_part_is_told_by_its_place():
    with host_calls({}) as calls:
        time.time()
        np.random.rand()
    assert [(call.part, call.what) for call in calls] == [("", CLOCK), ("", RANDOM)]


def test_libraries_may_ask_for_purposes_of_their_own():
    part = Part(lambda: (torch.rand(3), torch.compiler.is_compiling(), sorted([2, 1])))
    with host_calls({"part": part}) as calls:
        part()
    assert calls == []


def test_the_profiler_of_before_is_there_afterwards():
    def profiler(*_):
        return None

    sys.setprofile(profiler)
    try:
        with pytest.raises(ValueError, match="inside"), host_calls({}):
            raise ValueError("inside")
        assert sys.getprofile() is profiler
    finally:
        sys.setprofile(None)


def test_cprofile_goes_on_afterwards():
    profile = cProfile.Profile()
    profile.enable()
    try:
        with host_calls({}):
            pass
        helper()
    finally:
        profile.disable()
    # Without the names of built-in functions, which stand for their code.
    seen = {getattr(entry.code, "co_name", entry.code) for entry in profile.getstats()}
    assert "helper" in seen
