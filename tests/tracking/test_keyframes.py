"""Keyframes: easing, the pendulum's equation, feet that do not slip, and where the ground's pressure should be."""

import numpy as np
import pytest

from ksim_rl.tracking.keyframes import (
    Choreography,
    FootMove,
    eased,
    foot_paths,
    pendulum,
    smoothed,
    turned,
    zmp_plan,
)

TIME_F = np.arange(101) / 50.0


def steps():
    """A step ahead with the left foot, and one with the right foot beside it."""
    return Choreography(
        duration_s=2.0,
        feet=((0.0, 0.1, 0.0), (0.0, -0.1, 0.0)),
        moves=(
            FootMove(
                foot=0,
                begin_s=0.6,
                end_s=1.0,
                to=(0.3, 0.1, 0.5),
                lift=((0.2, 0.08),),
                pitch=((0.1, 0.4),),
            ),
            FootMove(foot=1, begin_s=1.1, end_s=1.5, to=(0.3, -0.1, 0.5), lift=((0.2, 0.08),)),
        ),
        root_height=((0.0, 0.7),),
    )


def test_between_keys_values_rest_at_both_ends():
    value_F = eased(((0.5, 1.0), (1.5, 3.0)), TIME_F)
    assert value_F[:26] == pytest.approx(1.0) and value_F[75:] == pytest.approx(3.0)
    assert value_F[50] == pytest.approx(2.0)
    speed_F = np.gradient(value_F, 0.02)
    # The fastest moment of the polynomial of fifth degree: 15 / 8 of the mean speed.
    assert speed_F.max() == pytest.approx(15.0 / 8.0 * 2.0, rel=2e-3)
    assert np.abs(np.gradient(speed_F, 0.02)[[25, 75]]).max() < 1.0, (
        "also the acceleration begins and ends at zero"
    )


def test_blurring_keeps_what_is_constant_or_even():
    ramp_F1 = TIME_F[:, None]
    assert smoothed(np.full((101, 2), 3.0), 2.0) == pytest.approx(3.0)
    assert smoothed(ramp_F1, 2.0)[10:-10] == pytest.approx(ramp_F1[10:-10])


def test_feet_stand_still_between_their_moves():
    paths_FN5, planted_FN = foot_paths(steps(), TIME_F)
    for foot, (begin, end) in enumerate(((30, 50), (55, 75))):
        still_F = planted_FN[:, foot]
        assert (np.flatnonzero(~still_F) == np.arange(begin + 1, end)).all()
        moved_F = np.abs(np.diff(paths_FN5[:, foot], axis=0)).max(-1)
        assert moved_F[still_F[:-1] & still_F[1:]].max() == 0.0
    assert paths_FN5[40, 0] == pytest.approx((0.15, 0.1, 0.08, 0.25, paths_FN5[40, 0, 4]))
    assert paths_FN5[35, 0, 4] == pytest.approx(0.4)
    assert paths_FN5[-1, :, :2] == pytest.approx(np.array(((0.3, 0.1), (0.3, -0.1))))


def test_pressure_is_under_the_foot_that_stands_alone():
    paths_FN5, planted_FN = foot_paths(steps(), TIME_F)
    zmp_F2 = zmp_plan(paths_FN5, planted_FN, shift_frames=14)
    assert zmp_F2[[0, 10]] == pytest.approx(0.0)
    assert zmp_F2[31:50] == pytest.approx(np.tile((0.0, -0.1), (19, 1)))
    assert zmp_F2[56:75] == pytest.approx(np.tile((0.3, 0.1), (19, 1)))
    assert zmp_F2[-1] == pytest.approx((0.3, 0.0))


def test_the_pendulum_fulfils_its_equation_and_rests_at_both_ends():
    zmp_F2 = smoothed(np.stack((TIME_F > 1.0, TIME_F < 0.8), axis=-1).astype(float), 2.0)
    height_F = 0.7 + 0.05 * np.sin(3.0 * TIME_F)
    com_F2 = pendulum(zmp_F2, height_F, 50.0)
    lift_F = np.gradient(np.gradient(height_F, 0.02), 0.02)
    acceleration_F2 = (com_F2[2:] - 2.0 * com_F2[1:-1] + com_F2[:-2]) * 50.0**2
    ratio_F1 = (height_F / (9.81 + lift_F))[1:-1, None]
    assert com_F2[1:-1] - ratio_F1 * acceleration_F2 == pytest.approx(zmp_F2[1:-1], abs=1e-9)
    assert com_F2[[0, -1]] == pytest.approx(zmp_F2[[0, -1]])


def test_orientations_are_pitched_then_turned():
    assert turned(0.0, 0.0) == pytest.approx((1.0, 0.0, 0.0, 0.0))
    half = np.sqrt(0.5)
    assert turned(np.pi / 2, np.pi / 2) == pytest.approx(
        (half * half, -half * half, half * half, half * half)
    )
