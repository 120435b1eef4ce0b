"""The config of a run: plain data and back, refused with the full path of what is wrong."""

import dataclasses
from pathlib import Path

import pytest

from ksim_rl import conf
from ksim_rl.trainers import RunCfg


@pytest.fixture(scope="module")
def cfg():
    return conf.compose(
        [
            "task=cartpole_balance",
            "num_envs=64",
            "data.num_env_states_per_minibatch=64",
            "data.num_minibatches=4",
        ]
    )


def test_plain_data_rebuilds_an_equal_config(cfg):
    assert RunCfg.from_tree(cfg.to_tree()) == cfg


def test_a_run_names_its_engine_and_one_that_does_not_was_made_by_warp(cfg):
    tree = cfg.to_tree()
    named = tree["task"]["sim"].pop("engine")
    assert named == cfg.task.sim.engine
    assert RunCfg.from_tree(tree).task.sim.engine == "warp"
    # An override of the field finds it there.
    changed = conf.changed(tree, Path("config.yaml"), ["task.sim.engine=c"])
    assert changed.task.sim.engine == "c"


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("num_envs", 0, r"num_envs=0: expected a whole number >= 1"),
        ("num_envs", "many", r"num_envs='many': expected int"),
        ("seed", -1, r"seed=-1: expected a whole number >= 0"),
        (
            "seed",
            2**63 - 1,
            r"seed=9223372036854775807: expected a whole number of at most 4611686018427387904",
        ),
        ("device", "gpu", r"device='gpu': expected 'auto', 'cpu', 'cuda' or"),
        ("trainer.num_iterations", 0, r"trainer.num_iterations=0: expected a whole number >= 1"),
        ("trainer.matmul_precision", "hig", r"trainer.matmul_precision='hig': did you mean 'high'"),
        ("trainer.video_s", -1.0, r"trainer.video_s=-1.0: expected a finite number in \(0"),
        ("objective.gamma", 1.5, r"objective.gamma=1.5: expected a finite number in"),
        ("modules.actor.hidden_dims", 64, "modules.actor.hidden_dims=64: expected a list of int"),
        ("trainer.stop_at", 3, "trainer.stop_at=3: expected a mapping from str to float or null"),
        ("task.scene.robots", 3, "task.scene.robots=3: expected a mapping from str to Robot"),
        (
            "modules.actor.hidden_dims",
            [64, "x"],
            r"modules.actor.hidden_dims\[1\]='x': expected int",
        ),
        (
            "modules.actor.activatio",
            "elu",
            r"unknown field 'modules.actor.activatio' of ActorCfg: did you mean",
        ),
        ("task.decimation", 0, r"task.decimation=0: expected a whole number"),
        (
            "task.rewards.balance._target_",
            "os.system",
            r"task.rewards.balance._target_='os.system': only classes of",
        ),
    ],
)
def test_a_wrong_value_is_refused_by_its_path(cfg, path, value, message):
    tree = cfg.to_tree()
    *parents, last = path.split(".")
    node = tree
    for key in parents:
        node = node[key]
    node[last] = value
    with pytest.raises(ValueError, match=message):
        RunCfg.from_tree(tree)


def test_a_dataset_that_the_envs_cannot_share_is_refused_with_working_numbers(cfg):
    with pytest.raises(
        ValueError, match=r"num_minibatches=4 = 256 .* num_envs=48.* num_envs=32 or 64"
    ):
        dataclasses.replace(cfg, num_envs=48)


def test_number_of_envs_and_seed_stand_in_one_place(cfg):
    other = dataclasses.replace(cfg, num_envs=32, seed=7)
    assert (other.task.scene.num_envs, other.task.seed) == (32, 7)
    tree = other.to_tree()
    assert "num_envs" not in tree["task"]["scene"] and "seed" not in tree["task"]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.scene.num_envs=7", "task.scene.num_envs=7 differs from num_envs=512: set num_envs"),
        ("task.seed=7", "task.seed=7 differs from seed=1: set seed"),
    ],
)
def test_the_envs_own_are_refused_where_they_differ(override, message):
    with pytest.raises(ValueError, match=message):
        conf.compose(["task=cartpole_balance", override])


def test_the_config_of_a_run_of_0_1_loads(cfg):
    tree = cfg.to_tree()
    del tree["objective"]["_target_"]
    tree["task"]["scene"]["num_envs"], tree["task"]["seed"] = 64, 1
    assert RunCfg.from_tree(tree) == cfg
    tree["task"]["seed"] = 5
    with pytest.raises(ValueError, match="task.seed=5 differs from seed=1"):
        RunCfg.from_tree(tree)


def test_the_networks_groups_must_be_there(cfg):
    task = dataclasses.replace(cfg.task, observations={"actor": cfg.task.observations["actor"]})
    with pytest.raises(ValueError, match="task.observations has no group 'critic'"):
        dataclasses.replace(cfg, task=task)
