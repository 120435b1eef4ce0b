"""The test of the num_envs benchmark, on scores whose p-value is known."""

import pytest

from benchmarks.num_envs import compare


def test_settings_that_are_the_same_have_p_1():
    figures = compare({64: [1.0, 2.0, 4.0], 256: [1.0, 2.0, 4.0], 1024: [1.0, 2.0, 4.0]})
    assert figures["p_value"] == 1.0
    assert figures["largest_difference"] == figures["difference_in_deviations"] == 0.0


def test_settings_far_apart_have_the_smallest_p():
    """Of the 6^4 exchanges within 4 seeds only the 6 that rename the settings keep their means as far apart."""
    seeds = [1.0, 2.0, 3.0, 4.0]
    figures = compare({64: seeds, 256: [s + 50.0 for s in seeds], 1024: [s + 90.0 for s in seeds]})
    assert figures["p_value"] == pytest.approx(6 / 6**4, abs=1e-4)
    assert figures["largest_difference"] == 90.0
    assert figures["seed_deviation"] == pytest.approx((5 / 3) ** 0.5, abs=1e-4)
    assert figures["256_envs/mean"] == 52.5


def test_the_share_is_counted_by_hand():
    """Two settings, two seeds: of 4 exchanges, 2 give the means (2, 4), 2 give (3, 3); only the former are as far."""
    assert compare({64: [1.0, 3.0], 256: [3.0, 5.0]})["p_value"] == 0.5
