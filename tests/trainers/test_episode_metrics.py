"""Sums over episodes as means that compare across tasks."""

import pytest

from ksim_rl.trainers.episode_metrics import episode_means

SUMS = {
    "sum/episodes": 4.0,
    "sum/length_sum": 400.0,
    "sum/return_sum": 36.0,
    "sum/reward/track": 80.0,
    "sum/termination/fell": 1.0,
    "sum/termination/non_finite": 0.0,
    "sum/metric/power": 10.0,
    "rollout/reward": 0.25,
}


def test_sums_become_means():
    means = episode_means(SUMS, max_episode_length_s=20.0)
    assert means == {
        "rollout/reward": 0.25,
        "episode/count": 4.0,
        "episode/non_finite": 0.0,
        "episode/return": 9.0,
        "episode/length": 100.0,
        "reward/track": 1.0,
        "termination/fell": 0.25,
        "termination/non_finite": 0.0,
        "metric/power": 2.5,
    }


def test_without_a_finished_episode_there_are_no_means():
    means = episode_means(dict.fromkeys(SUMS, 0.0), max_episode_length_s=20.0)
    assert means == {"rollout/reward": 0.0, "episode/count": 0.0, "episode/non_finite": 0.0}


def test_episodes_without_a_limit_give_sums_per_episode():
    assert episode_means(SUMS, max_episode_length_s=0.0)["reward/track"] == 20.0


def test_an_env_without_episode_log_gives_what_it_has():
    assert episode_means({"rollout/reward": 1.0}, max_episode_length_s=1.0) == pytest.approx(
        {"rollout/reward": 1.0}
    )
