"""The YAML files say what the dataclasses say, and each choice composes."""

from importlib.resources import files

import pytest
from omegaconf import OmegaConf

from ksim_rl import conf, envs
from ksim_rl.collectors import CollectorCfg
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import to_tree
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import ModulesCfg, TrainerCfg
from ksim_rl.trainers.loggers import LoggerCfg, MLflowCfg, WandbCfg

FOLDER = files("ksim_rl.conf")
DATA = DatasetCfg(num_env_states_per_minibatch=4096, num_minibatches=4)


def read(name):
    return OmegaConf.to_container(OmegaConf.create((FOLDER / name).read_text()))


@pytest.mark.parametrize(
    ("name", "cfg"),
    [
        ("collector/rollout.yaml", CollectorCfg(stagger_episodes=True)),
        ("data/on_policy.yaml", DATA),
        ("objective/ppo.yaml", PPOCfg()),
        ("modules/mlp.yaml", ModulesCfg()),
        ("trainer/on_policy.yaml", TrainerCfg()),
        ("logger/local.yaml", LoggerCfg()),
        ("logger/none.yaml", LoggerCfg(csv=False, tensorboard=False)),
        ("logger/wandb.yaml", LoggerCfg(tensorboard=False, wandb=WandbCfg())),
        ("logger/mlflow.yaml", LoggerCfg(tensorboard=False, mlflow=MLflowCfg())),
    ],
)
def test_a_yaml_file_lists_every_field(name, cfg):
    assert read(name) == to_tree(cfg, type(cfg))


@pytest.mark.parametrize("name", envs.names())
def test_each_task_composes_with_its_training_defaults(name):
    cfg = conf.compose([f"task={name}"])
    tree = cfg.to_tree()
    assert cfg.task_name == name
    assert cfg.task.scene.num_envs == cfg.num_envs
    for path, value in envs.task(name).training.items():
        node = tree
        for key in path.split("."):
            node = node[key]
        assert node == (list(value) if isinstance(value, tuple) else value), path


def test_the_command_line_overrides_the_tasks_defaults():
    cfg = conf.compose(["task=cartpole_swingup", "num_envs=128", "trainer.num_iterations=7", "seed=5"])
    assert (cfg.num_envs, cfg.task.scene.num_envs) == (128, 128)
    assert (cfg.trainer.num_iterations, cfg.seed, cfg.task.seed) == (7, 5, 5)


def test_a_group_choice_replaces_the_group():
    assert conf.compose(["logger=none"]).logger == LoggerCfg(csv=False, tensorboard=False)
