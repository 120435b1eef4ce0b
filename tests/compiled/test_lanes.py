"""Lanes give the bits of one thread, in whatever order they run between waits, and wait seldom."""

import re

import pytest
import torch

from ksim_rl.collectors.compiled_step import CompiledStep
from ksim_rl.compiled import lanes, tape
from ksim_rl.device import recording
from tests.collectors.test_compiled_step import made
from tests.compiled.test_tape import CASES, E, floats, whole

NUMBER = 3
"""Lanes, where some have one place more than others."""
DECLARED = re.compile(r"^([\w ]+) ([mc]\d+)\[(.+)\];$")


def emulate(monkeypatch, order):
    """Let one thread of the CPU run each level of a kernel lane by lane; return the sources of kernels."""
    sources = []

    def emulated(*arguments):
        lines, levels, own = list(lanes.source(*arguments)), [[]], {}
        yield f"if (lane > 0) return; const int first = {order[0]}, step = {order[1]};"
        for line in lines:
            declared = DECLARED.match(line)
            if declared:  # each lane has its own
                own[declared[2]] = f"{declared[1]} {declared[2]}[{NUMBER}][{declared[3]}];"
            elif line == "WAIT":
                levels.append([])
            elif line.startswith("ARRAY"):
                yield line
            else:
                levels[-1].append(line)
        yield from own.values()
        for level in levels:
            yield f"for (int lane = first; lane >= 0 && lane < {NUMBER}; lane += step) {{ {lanes.DEAL}"
            for line in level:
                yield re.sub(
                    r"\b([mc]\d+)\[", lambda m: f"{m[1]}[lane][" if m[1] in own else m[0], line
                )
            yield "}"
        sources.append(lines)

    monkeypatch.setitem(lanes.LANES, "cpu", NUMBER)
    monkeypatch.setattr(tape, "source", emulated)
    return sources


def taped(function, *inputs):
    inputs = [x.clone() for x in inputs]
    with recording.recorded() as recorder:
        results = function(*inputs)
    replay = tape.Tape(recorder, num_rows=E, returned=results)
    for held, x in zip(inputs, (x.flip(0) for x in inputs), strict=True):
        held.copy_(x)
    replay()
    return *results, *inputs


def all_cases(x):
    return tuple(case(x) for case in CASES.values())


def in_place(state, other, mask):
    """Take from neighbours what they are about to change, in places and shapes of all kinds."""
    count = torch.zeros(E)
    count += 1.0
    state[:, 1:].copy_(state[:, :-1] * 2.0)
    state.add_(state.sum(-1, keepdim=True))
    last = other[:, -1] + count
    other.copy_(torch.where(mask, state.view(E, 2, 3).transpose(1, 2).reshape(E, 6), other))
    count += last
    other[:, 0].sub_(count)
    return state.view(E, 3, 2).sum(-1), other * count[:, None], other.flip(1) + state


ORDERS = {"first lane first": (0, 1), "last lane first": (NUMBER - 1, -1)}
FUNCTIONS = {
    "of all kinds": (all_cases, (floats(4),)),
    "in place": (in_place, (floats(6), floats(2, 3).view(E, 6), whole(6) > 0)),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_lanes_give_what_one_thread_gives(name, order, monkeypatch):
    function, inputs = FUNCTIONS[name]
    expected = taped(function, *inputs)
    sources = emulate(monkeypatch, ORDERS[order])
    found = taped(function, *inputs)
    assert sources
    for own, true in zip(found, expected, strict=True):
        assert torch.equal(own.nan_to_num(7.0), true.nan_to_num(7.0))


@pytest.mark.parametrize("order", ORDERS)
def test_lanes_make_the_step_of_an_env(order, monkeypatch):
    sources = emulate(monkeypatch, ORDERS[order])
    CompiledStep(*made())
    assert max(lines.count("WAIT") for lines in sources) < 12


def test_a_row_of_more_memory_than_the_chip_has_is_one_thread_s(monkeypatch):
    monkeypatch.setitem(lanes.LANES, "cpu", NUMBER)
    launched = []

    class Noted(tape.QuickLaunch):
        def __call__(self, device, dim, *values):
            launched.append(dim)

    monkeypatch.setattr(tape, "QuickLaunch", Noted)
    for size in (12, 3000):
        taped(lambda x: (torch.cat((x.abs()[:, 1:], x), 1),), floats(size))
    assert launched == [(E, NUMBER), (E, 1)]
