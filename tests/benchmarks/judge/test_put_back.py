"""Faults that are put back stand where what mends them is, and generated models have what they need."""

import importlib

import pytest

from benchmarks.judge import generator
from benchmarks.judge.put_back import FAULTS, PHYSICS, put_back


@pytest.mark.parametrize("name", FAULTS)
def test_what_mends_a_fault_is_left_out_for_a_while(name: str):
    fault = FAULTS[name]
    module = importlib.import_module(f"{PHYSICS}.{fault.place[0]}")
    mends = vars(module)[fault.place[1]]
    with put_back(fault):
        assert vars(module)[fault.place[1]] is fault.instead
    assert vars(module)[fault.place[1]] is mends


@pytest.mark.parametrize("name", FAULTS)
def test_a_generated_model_has_what_a_fault_needs(name: str):
    needs = FAULTS[name].needs
    assert any(generator.generate(0, number).features.issuperset(needs) for number in range(600))
