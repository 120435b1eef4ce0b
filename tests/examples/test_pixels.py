"""Trains the example of a policy that sees until it goes to the ball, and shows that a blind one does not."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "pixels.py"


@pytest.fixture
def example():
    spec = importlib.util.spec_from_file_location("pixels", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.full
def test_it_learns_what_only_pictures_show(example, capsys):
    assert example.train(num_iterations=40) > 0.87
    assert "iteration 40: reward per step" in capsys.readouterr().out
    # A camera that looks up at nothing: the middle of the rail is the best guess, 0.5 m away in the mean.
    example.CAMERA = replace(example.CAMERA, xyaxes=(1.0, 0.0, 0.0, 0.0, -1.0, 0.0))
    assert example.train(num_iterations=40) < 0.6
