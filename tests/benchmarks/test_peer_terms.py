"""Differences from mjlab's terms count where both mean the same, and only there."""

import numpy as np
import pytest

from benchmarks.peer_terms import differences, newtons

STEPS, ENVS = 3, 2


def run(ours=None, theirs=None):
    """Return the differences of two runs in which everything is 1 but what is given."""
    shapes = {"reward/pose": (), "reward/foot_swing_height": (), "obs/foot_contact_forces": (3,)}
    record = {name: np.ones((STEPS, ENVS, *shape), np.float32) for name, shape in shapes.items()}
    values = {name: value.copy() for name, value in record.items()}
    for name in ("moment/foot_height", "obs/critic/foot_height"):
        values[name] = np.ones((STEPS, ENVS, 4), np.float32)
    record["obs/critic/foot_height"] = values["obs/critic/foot_height"].copy()
    record |= {"substep/ctrl": np.ones((STEPS * 4, ENVS, 2)), "action": np.ones((STEPS, ENVS, 2))}
    record["reset"] = np.zeros((STEPS, ENVS), bool)
    record["reset"][1, 0] = True
    for name, (where, value) in (ours or {}).items():
        values[name][where] = value
    for name, (where, value) in (theirs or {}).items():
        record[name][where] = value
    return dict(differences(record, {name: list(value) for name, value in values.items()}, [1, 0]))


def test_a_difference_is_a_share_of_the_largest_number():
    assert set(run().values()) == {0.0}
    found = run(ours={"reward/pose": ((2, 1), 3.0)}, theirs={"reward/pose": ((0, 0), 4.0)})
    assert found["reward/pose"] == pytest.approx(3.0 / 4.0)


def test_swings_count_until_the_first_reset():
    assert run(ours={"reward/foot_swing_height": ((1, 0), 2.0)})["reward/foot_swing_height"] == 1.0
    assert run(ours={"reward/foot_swing_height": ((2, 0), 2.0)})["reward/foot_swing_height"] == 0.0
    assert run(ours={"reward/foot_swing_height": ((2, 1), 2.0)})["reward/foot_swing_height"] == 1.0


def test_feet_below_the_plane_are_left_out():
    assert run(ours={"obs/critic/foot_height": ((0, 0, 2), 0.5)})["obs/critic/foot_height"] == 0.5
    assert run(ours={"obs/critic/foot_height": ((0, 0, 2), -0.5)})["obs/critic/foot_height"] == 0.0


def test_scaled_forces_become_newtons():
    force = np.array([-500.0, 0.0, 2.5])
    np.testing.assert_allclose(newtons(np.sign(force) * np.log1p(np.abs(force))), force)
