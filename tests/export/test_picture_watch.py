"""A camera that is frozen ends in damped motors, by the stamps of its pictures or by pictures that stay the same."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from tests.export.loop_bench import Script, run, set_up

NAME = "picture_wrist"
# A camera of 25 Hz in a loop of 50 Hz.
SPEC = {"input": NAME, "every": 2, "delay": None}
FROZEN_AT = 0.81


def noisy(now):
    draws = np.random.default_rng(round(min(now, FROZEN_AT) / 0.04))
    return draws.integers(0, 255, (2, 3, 3), dtype=np.uint8)


def still(now):
    return np.zeros((2, 3, 3), np.uint8)


CASES = {
    "noisy, then frozen": (noisy, None, f"{NAME}: its pictures are the same for 0.5"),
    "without noise and without stamps": (still, None, f"{NAME}: its pictures are the same for"),
    "stamped, then frozen": (still, lambda now: min(now, FROZEN_AT), "is 0.130 s old"),
    "of another clock": (still, lambda now: now + 5.0, "is 5.000 s ahead of the loop"),
    "stamped": (still, lambda now: now - 0.1, ""),
    "without pictures": (None, None, ""),
}


@pytest.mark.parametrize("name", CASES)
def test_a_frozen_camera_is_named(control, name):
    picture, stamp, said = CASES[name]
    control.pictures = [SPEC]
    clock, robot, machine, lines = set_up(control)

    def seen(measurement):
        fields = {}
        if picture is not None:
            fields["pictures"] = {NAME: picture(clock.now())}
        if stamp is not None:
            fields["picture_stamps"] = {NAME: stamp(clock.now())}
        return dataclasses.replace(measurement, **fields)

    robot.harm = seen
    run(clock, robot, machine, lines, Script(damp=2.0))
    assert said in machine.fault and bool(said) == bool(machine.fault)


def test_a_lag_of_the_training_is_no_frozen_camera(control):
    control.pictures = [SPEC | {"delay": {"max": 4}}]
    clock, robot, machine, lines = set_up(control)

    def seen(measurement):
        stamps = {NAME: clock.now() - 0.19}
        return dataclasses.replace(measurement, picture_stamps=stamps)

    robot.harm = seen
    run(clock, robot, machine, lines, Script(damp=0.5))
    assert not machine.fault
