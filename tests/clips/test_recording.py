"""Rotations, chains of joints, and other rates, against closed forms and MuJoCo's own quaternions."""

import re

import mujoco
import numpy as np
import pytest

from ksim_rl.clips.recording import (
    Recording,
    between,
    chain,
    from_rotation_vector,
    multiply,
    rotate,
    slerp,
)


def test_quaternions_are_those_of_mujoco():
    draw, found = np.random.default_rng(0), np.empty(4)
    a, b = (q / np.linalg.norm(q) for q in draw.normal(size=(2, 4)))
    mujoco.mju_mulQuat(found, a, b)
    assert multiply(a, b) == pytest.approx(found)
    v, turned = draw.normal(size=3), np.empty(3)
    mujoco.mju_rotVecQuat(turned, v, a)
    assert rotate(a, v) == pytest.approx(turned)
    mujoco.mju_axisAngle2Quat(found, v / np.linalg.norm(v), np.linalg.norm(v))
    assert from_rotation_vector(v) == pytest.approx(found)
    assert from_rotation_vector(np.zeros(3)) == pytest.approx([1.0, 0.0, 0.0, 0.0])


def test_slerp_turns_evenly_and_on_the_shorter_arc():
    first, last = from_rotation_vector(np.array(((0.0, 0.0, 0.2), (0.0, 0.0, 1.4))))
    for share in (0.0, 0.25, 1.0):
        expected = from_rotation_vector(np.array((0.0, 0.0, 0.2 + 1.2 * share)))
        assert slerp(first, -last, np.array([share])) == pytest.approx(expected)


def test_a_chain_of_two_bones():
    quarter = from_rotation_vector(np.array((0.0, 0.0, np.pi / 2)))
    turns_FN4 = np.stack([quarter, quarter, np.array((1.0, 0, 0, 0))])[None]
    offsets_N3 = np.array(((9.0, 9.0, 9.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0)))
    pos_FN3, quat_FN4 = chain([-1, 0, 1], offsets_N3, turns_FN4, np.array(((0.5, 0.0, 0.0),)))
    # The root turns the first bone to +y, and the joint at its end the second one to -x.
    assert pos_FN3[0] == pytest.approx(np.array(((0.5, 0, 0), (0.5, 1, 0), (-1.5, 1, 0))))
    assert quat_FN4[0, 2] == pytest.approx(from_rotation_vector(np.array((0, 0, np.pi))))


def test_other_rates_meet_a_motion_of_constant_speed():
    time_F = np.arange(31) / 30.0
    pos_FN3 = np.stack((2.0 * time_F, -time_F, 0.0 * time_F), axis=-1)[:, None]
    quat_FN4 = from_rotation_vector(np.stack((0 * time_F, 0 * time_F, 3.0 * time_F), axis=-1))[
        :, None
    ]
    played = Recording(fps=30.0, names=("a",), pos_FN3=pos_FN3, quat_FN4=quat_FN4).resampled(50.0)
    at_F = np.arange(51) / 50.0
    assert played.pos_FN3.shape == (51, 1, 3)
    assert played.pos_FN3[:, 0, 0] == pytest.approx(2.0 * at_F)
    angle_F = 2.0 * np.arctan2(played.quat_FN4[:, 0, 3], played.quat_FN4[:, 0, 0])
    assert np.unwrap(angle_F, period=4 * np.pi) == pytest.approx(3.0 * at_F, abs=1e-9)


@pytest.mark.parametrize(
    ("fps", "wanted", "said"),
    [
        (
            1e-300,
            50.0,
            "frames per second of the recording=1e-300: expected a finite number in [0.01, 100000.0]",
        ),
        (np.inf, 50.0, "frames per second of the recording=inf: expected a finite number"),
        (30.0, 0.0, "frames per second=0.0: expected a finite number"),
        (
            0.01,
            1e5,
            "3 frames, 0.01 of them per second, are 2e+07 at 100000 per second: expected 10000000 at most",
        ),
    ],
)
def test_rates_by_which_few_frames_last_for_ever_are_refused(fps, wanted, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        between(3, fps, wanted)
