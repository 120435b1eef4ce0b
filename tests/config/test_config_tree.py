"""Config round trips, and errors that name the field's full path."""

import pytest
from omegaconf import OmegaConf

from ksim_rl import envs
from ksim_rl.envs import ManagerBasedRlEnvCfg, from_tree, to_tree
from tests.task_names import NAMES


@pytest.mark.parametrize("name", NAMES)
def test_every_task_survives_omegaconf(name):
    cfg = envs.task(name).cfg()
    tree = OmegaConf.create(to_tree(cfg, ManagerBasedRlEnvCfg))
    assert from_tree(ManagerBasedRlEnvCfg, OmegaConf.to_container(tree)) == cfg


def edited(path, value):
    tree = OmegaConf.create(to_tree(envs.task("cartpole_balance").cfg(), ManagerBasedRlEnvCfg))
    OmegaConf.update(tree, path, value, force_add=True)
    return OmegaConf.to_container(tree)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("decimatoin", 2, "unknown field 'task.decimatoin'.*'decimation'"),
        ("decimation", "two", "task.decimation='two': expected int"),
        ("decimation", 0, "task.decimation=0"),
        ("scene.num_envs", -3, "task.scene.num_envs=-3"),
        ("rewards.balance.weight", "heavy", "task.rewards.balance.weight='heavy': expected float"),
        ("rewards.balance.wieght", 1.0, "unknown field 'task.rewards.balance.wieght'.*'weight'"),
        ("sim.timestep", -1.0, "task.sim.timestep"),
        ("rewards.balance._target_", "os.system", "only classes of these packages"),
        ("rewards.balance._target_", "ksim_rl.tasks.cartpole.CartpoleRewards", "'CartpoleReward'"),
        (
            "rewards.balance._target_",
            "ksim_rl.mdp.observations.joints.JointVel",
            "expected a kind of RewardTerm",
        ),
        ("episode_length_s", 0.0, "time-out termination 'time_out'"),
    ],
)
def test_errors_name_the_full_path_and_what_is_valid(path, value, message):
    with pytest.raises(ValueError, match=message):
        from_tree(ManagerBasedRlEnvCfg, edited(path, value), "task")


def test_a_missing_field_is_named():
    tree = edited("decimation", 1)
    del tree["decimation"]
    with pytest.raises(ValueError, match="needs the field 'decimation': int"):
        from_tree(ManagerBasedRlEnvCfg, tree, "task")
