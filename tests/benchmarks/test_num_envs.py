"""The test of the num_envs benchmark, on scores whose p-value is known."""

import pytest

from benchmarks.num_envs import EXCHANGES, compare, exchanges


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


def test_many_seeds_draw_exchanges():
    """With 20 seeds there are 6^20: of many drawn ones none comes as far, so that the given order is the only one."""
    seeds = [float(seed) for seed in range(20)]
    scores = {64: seeds, 256: [s + 50.0 for s in seeds], 1024: [s + 90.0 for s in seeds]}
    figures = compare(scores)
    assert figures["p_value"] == pytest.approx(1.0 / EXCHANGES, abs=1e-4)
    drawn = list(exchanges(list(zip(*scores.values(), strict=True))))
    assert len(drawn) == EXCHANGES
    assert all(sorted(row) == sorted(own) for row, own in zip(drawn[-1], drawn[0], strict=True))


def test_the_bound_is_that_of_the_difference_seed_by_seed():
    """Differences of 1, 2 and 3: 2 on average, with a deviation of 1, so 2 + 1.96 / sqrt(3) at most."""
    figures = compare({64: [0.0, 10.0, 20.0], 256: [1.0, 12.0, 23.0]})
    assert figures["largest_difference"] == pytest.approx(2.0)
    assert figures["largest_difference_at_most"] == pytest.approx(2.0 + 1.96 / 3**0.5, abs=1e-4)
