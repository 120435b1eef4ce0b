"""Faults that are put back stand where what mends them is, and generated models have what they need."""

import functools

import pytest

from benchmarks.judge import generator
from benchmarks.judge.faults import FAULTS, Rewrite, place_of, put_back
from benchmarks.judge.put_back import suits
from tests.docs.guide import REPOSITORY


@pytest.mark.parametrize("name", FAULTS)
def test_what_mends_a_fault_is_left_out_for_a_while(name: str):
    owner, place = place_of(FAULTS[name])
    mends = vars(owner)[place]
    with put_back(FAULTS[name]):
        assert vars(owner)[place] is not mends
    assert vars(owner)[place] is mends


@pytest.mark.parametrize(
    "name", [name for name, fault in FAULTS.items() if isinstance(fault.instead, Rewrite)]
)
def test_lines_of_cpp_that_are_written_as_they_were_stand_there(name: str):
    rewrite = FAULTS[name].instead
    assert isinstance(rewrite, Rewrite)
    headers = (REPOSITORY / "ksim_rl").rglob("*.cuh")
    text = "".join(path.read_text() for path in headers)
    for line in rewrite.lines:
        assert text.count(line) == 1


def test_all_faults_of_the_issue_are_there():
    assert {int(fault.number) for fault in FAULTS.values() if fault.number} == set(range(1, 14))


@functools.cache
def generated(number: int) -> generator.Generated:
    """Return a model of the hunt; faults ask for the same ones."""
    return generator.generate(0, number)


@pytest.mark.parametrize("name", FAULTS)
def test_a_generated_model_has_what_a_fault_needs(name: str):
    fault = FAULTS[name]
    assert any(suits(fault, generated(number)) for number in range(1500))
