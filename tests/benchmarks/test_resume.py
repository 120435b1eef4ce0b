"""The resume table: it sees any difference, and the command itself leaves none."""

import pytest
import torch

from benchmarks import resume
from ksim_rl.cli import main

STATE = {
    "seconds": 3.0,
    "iteration": 4,
    "update": {"actor": {"weight": torch.tensor([1.0, float("nan")])}, "optimizer": {"rate": 0.5}},
    "env": {"base_env.world.qpos": torch.zeros(2)},
}


def changed(**parts):
    return {**STATE, **parts}


def test_equal_states_differ_in_nothing_and_each_leaf_is_counted_but_the_seconds():
    comparison = resume.compare(STATE, changed(seconds=9.0))
    assert (comparison.tensors_compared, comparison.tensors_that_differ) == (4, 0)
    assert comparison.compared == {
        "iteration": 1,
        "policy and its normalizers": 1,
        "optimizers": 1,
        "physics": 1,
    }


def test_each_kind_of_difference_is_seen():
    weight = {"weight": torch.tensor([1.0, 2.0])}
    for other, path in (
        (
            changed(env={"base_env.world.qpos": torch.tensor([0.0, -0.0])}),
            "/env/base_env.world.qpos",
        ),
        (changed(env={"base_env.world.qpos": torch.zeros(2, 1)}), "/env/base_env.world.qpos"),
        (changed(env={"base_env.world.qpos": torch.zeros(2).double()}), "/env/base_env.world.qpos"),
        (changed(update={**STATE["update"], "actor": weight}), "/update/actor/weight"),
        (
            changed(update={**STATE["update"], "optimizer": {"rate": 0.25}}),
            "/update/optimizer/rate",
        ),
        (changed(iteration=5), "/iteration"),
        (changed(hooks={}), "/hooks"),
    ):
        for one, two in ((STATE, other), (other, STATE)):
            differing = [
                path for paths in resume.compare(one, two).differing.values() for path in paths
            ]
            assert differing == [path]


def in_this_process(*words):
    with pytest.raises(SystemExit) as stopped:
        main.main(list(words))
    assert stopped.value.code == 0


@pytest.mark.full
def test_a_run_resumed_by_the_command_in_a_new_process_is_bit_identical(tmp_path):
    small = (
        "task=quadruped_velocity_flat",
        "num_envs=2",
        "data.num_env_states_per_minibatch=4",
        "data.num_minibatches=2",
    )
    overrides = (*resume.TASK, *small, "task.episode_length_s=0.1")
    comparison = resume.compare_runs(overrides, tmp_path, num_iterations=2, train=in_this_process)
    assert comparison.differing == {}
    assert {
        "physics",
        "optimizers",
        "curricula",
        "transforms: noise, delay, history",
        "randomized model",
    } <= set(comparison.compared)
