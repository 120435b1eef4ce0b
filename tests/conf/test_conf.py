"""Each choice of a group composes, and tasks set what differs from the defaults."""

import dataclasses

import pytest

from ksim_rl import algorithms, conf, envs
from ksim_rl.collectors import CollectorCfg
from ksim_rl.conf import registration
from ksim_rl.conf.choices import CHOICES
from ksim_rl.envs import Task
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import TrainerCfg, TrainingCfg
from ksim_rl.trainers.loggers import LoggerCfg, MLflowCfg, WandbCfg
from tests.task_names import NAMES


def test_without_a_task_of_its_own_settings_a_run_has_the_dataclasses_defaults(monkeypatch):
    bare = dataclasses.replace(envs.task("cartpole_balance"), training=None)
    monkeypatch.setattr(envs, "task", lambda name: bare)
    from ksim_rl.conf import choices

    assert choices.objective_defaults("cartpole_balance", "ppo") == {}
    assert set(choices.training_defaults("cartpole_balance")) == {"task_name", "num_envs", "task"}


def test_the_defaults_are_those_of_the_dataclasses():
    cfg = conf.compose(["task=go1_velocity_flat"])
    assert cfg.collector == CollectorCfg(stagger_episodes=True)
    assert cfg.logger == LoggerCfg()
    assert cfg.trainer == TrainerCfg(num_iterations=10_000)
    assert cfg.objective == PPOCfg(gamma=0.98, precision="auto")


@pytest.mark.parametrize(
    ("name", "cfg"),
    [
        ("none", LoggerCfg(csv=False, tensorboard=False)),
        ("wandb", LoggerCfg(tensorboard=False, wandb=WandbCfg())),
        ("mlflow", LoggerCfg(tensorboard=False, mlflow=MLflowCfg())),
    ],
)
def test_a_logger_is_chosen_by_name(name, cfg):
    assert conf.compose([f"logger={name}"]).logger == cfg


@pytest.mark.parametrize("name", NAMES)
def test_each_task_composes_with_its_training(name):
    cfg, training = conf.compose([f"task={name}"]), envs.task(name).training
    assert isinstance(training, TrainingCfg) and cfg.task_name == name
    assert cfg.task.scene.num_envs == cfg.num_envs
    for field in dataclasses.fields(TrainingCfg):
        assert getattr(cfg, field.name) == getattr(training, field.name), field.name


# All of those with such settings in full runs.
TRAINED_OTHERWISE = [
    name
    if name in ("go1_velocity_flat", "walker_walk")
    else pytest.param(name, marks=pytest.mark.full)
    for name in envs.names()
    if envs.task(name).other_trainings
]


@pytest.mark.parametrize("name", TRAINED_OTHERWISE)
def test_each_task_composes_with_its_training_by_other_algorithms(name):
    for training in envs.task(name).other_trainings:
        objective = algorithms.registry.serving(type(training.objective)).name
        cfg = conf.compose([f"task={name}", f"objective={objective}"])
        for field in dataclasses.fields(TrainingCfg):
            assert getattr(cfg, field.name) == getattr(training, field.name), field.name


@pytest.mark.parametrize("name", [name for name in CHOICES["modules"] if name != "mlp"])
def test_what_a_task_sets_lies_over_other_networks(name):
    cfg, choice = conf.compose(["task=walker_walk", f"modules={name}"]), CHOICES["modules"][name]
    assert cfg.modules.actor.hidden_dims == (256, 128) and cfg.modules.actor.init_std == 0.6
    assert (
        cfg.modules.recurrent_actor == choice.recurrent_actor and cfg.modules.trunk == choice.trunk
    )


def test_a_task_with_settings_as_they_were_in_0_1_is_refused(monkeypatch):
    old = Task(
        name="old",
        description="",
        cfg=envs.task("arm_reach").cfg,
        training={"objective.gamma": 0.9},
    )
    monkeypatch.setattr(envs, "task", lambda name: old)
    from ksim_rl.conf import choices

    with pytest.raises(
        ValueError, match="task 'old': training is a dict; expected a .*TrainingCfg"
    ):
        choices.training_defaults("old")


def test_the_command_line_overrides_the_tasks_defaults():
    cfg = conf.compose(
        ["task=cartpole_swingup", "num_envs=128", "trainer.num_iterations=7", "seed=5"]
    )
    assert (cfg.num_envs, cfg.task.scene.num_envs) == (128, 128)
    assert (cfg.trainer.num_iterations, cfg.seed, cfg.task.seed) == (7, 5, 5)


def test_a_group_choice_replaces_the_group():
    assert conf.compose(["logger=none"]).logger == LoggerCfg(csv=False, tensorboard=False)


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ("seed=1,task=x", "3_seed=1,task=x"),
        ("", "3_cartpole_balance"),
        ("checkpoint=/a/../b", "3_checkpoint=-a-..-b"),
        ("a" * 500, "3_" + "a" * 120),
    ],
)
def test_the_folder_of_a_job_is_one_folder(overrides, name):
    assert registration.job_folder(3, "cartpole_balance", overrides) == name


def test_what_jobs_differ_in_is_told_from_what_they_share():
    assert conf.without_sweeps(["seed=1,2", "+a.b=[1,2]", "num_envs=3", "c=choice(1,2)"]) == [
        "+a.b",
        "num_envs",
    ]
