"""Sums over episodes as means that compare across tasks."""

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.runs.csv_table import CsvTable, read_table
from ksim_rl.trainers.metrics import episode_means, read_episode_sums, start_copy
from tests.envs.probe_env import DT, Position, puck_env_in_c

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


def test_rewards_ends_and_the_levels_of_curricula_and_commands_reach_the_table(tmp_path):
    ranges = {"start": {"height": (0.5, 0.5)}, "end": {"height": (0.0, 1.0)}}
    env = puck_env_in_c(
        limit=0.1,
        episode_length_s=4 * DT,
        rewards={"position": Position(), "still": Position(weight=-0.5)},
        commands={"height": mdp.BaseHeightCommand(resampling_time_range_s=None, height=(0.2, 0.4))},
        curriculum={
            "level": mdp.LinearLevel(end_step=16),
            "heights": mdp.CommandRangesByLevel(command="height", **ranges),
        },
    )
    rollout_ET = env.rollout(
        4, lambda td: td.set("action", torch.zeros(3, 1)), break_when_any_done=False
    )
    env.reset()  # the level moves when envs reset
    sums = start_copy(read_episode_sums(env, rollout_ET), device=env.device).read()
    table = CsvTable(tmp_path / "metrics.csv")
    table.log_metrics(episode_means(sums, max_episode_length_s=env.max_episode_length_s), 12)
    (row,) = read_table(tmp_path / "metrics.csv")[1]
    # In four steps: env 0 times out once; 1 is beyond 0.1 m in step 3, 2 in steps 2 and 4.
    assert float(row["episode/count"]) == 4 and float(row["termination/time_out"]) == 0.25
    assert float(row["termination/beyond"]) == 0.75 and float(row["termination/non_finite"]) == 0.0
    assert float(row["reward/still"]) == pytest.approx(-0.5 * float(row["reward/position"])) != 0.0
    assert float(row["curriculum/level"]) == float(row["curriculum/heights"]) == 0.25
    assert (
        float(row["command/height/height_low"]) == 0.375
        and float(row["command/height/height_high"]) == 0.625
    )
    assert env.episode_log()["episodes"] == 0.0, "and the sums start over"


def test_without_a_curriculum_there_are_no_levels_to_report():
    env = puck_env_in_c(
        commands={"height": mdp.BaseHeightCommand(resampling_time_range_s=None, height=(0.2, 0.4))}
    )
    assert env.command_levels() == {} and env.curriculum_levels() == {}
