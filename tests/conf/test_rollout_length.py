"""A rollout length may be given in place of the dataset's size."""

import pytest

from ksim_rl import conf
from ksim_rl.cli import report
from ksim_rl.trainers import RunCfg


@pytest.mark.parametrize("num_envs", [16, 4096])
def test_the_dataset_follows_for_any_number_of_envs(num_envs):
    cfg = conf.compose(
        ["task=quadruped_velocity_flat", f"num_envs={num_envs}", "collector.rollout_length=24"]
    )
    assert cfg.data.rollout_length(num_envs) == 24
    assert RunCfg.from_tree(cfg.to_tree()) == cfg


def test_that_of_a_replay_follows_too():
    cfg = conf.compose(["objective=fast_sac", "num_envs=16", "collector.rollout_length=3"])
    assert cfg.data.rollout_length(16) == 3


@pytest.mark.parametrize("data", ["data.num_env_states_per_minibatch=64", "data.num_steps=2"])
def test_both_are_refused(data):
    objective = "objective=fast_sac" if "num_steps" in data else "objective=ppo"
    with pytest.raises(ValueError, match="leave one of the two out"):
        conf.compose([objective, "num_envs=16", "collector.rollout_length=8", data])


def test_lengths_that_do_not_split_are_refused_with_those_that_do():
    with pytest.raises(ValueError, match=r"collector.rollout_length=4 or 8 are"):
        conf.compose(["num_envs=1", "data.num_minibatches=4", "collector.rollout_length=5"])


def test_a_length_far_from_the_tasks_own_is_said():
    few = ["task=quadruped_velocity_flat", "num_envs=16"]
    far, near = conf.compose(few), conf.compose([*few, "collector.rollout_length=24"])
    length = far.data.rollout_length(16)
    assert length > 1000
    assert (
        report._far_from(far, length)
        == "24 that quadruped_velocity_flat is tuned for, with 4096 envs"
    )
    assert report._far_from(near, 24) == ""
