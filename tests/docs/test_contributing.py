"""The recipes of CONTRIBUTING.md run as they stand, one after the other."""

import dataclasses
import re
import sys
import types

import pytest
import torch

from ksim_rl import algorithms, envs
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv, check_env
from ksim_rl.trainers import RunCfg, TrainerCfg, build
from tests.docs.guide import REPOSITORY

NAME = "contributed"
RECIPES = dict(
    re.findall(
        r"<!-- recipe: (\w+) -->\n```python\n(.*?)```",
        (REPOSITORY / "CONTRIBUTING.md").read_text(),
        re.DOTALL,
    )
)


@pytest.fixture(scope="module")
def contributed():
    """Run all recipes in one module, as one contributor would write them."""
    module = types.ModuleType(NAME)
    sys.modules[NAME] = module
    code = compile("".join(RECIPES.values()), "CONTRIBUTING.md", "exec", dont_inherit=True)
    exec(code, vars(module))  # noqa: S102
    yield module
    del sys.modules[NAME]


@pytest.fixture(scope="module")
def env(contributed):
    cfg = contributed.TASK.cfg()
    return envs.build(dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, num_envs=4)))


def test_there_is_a_recipe_for_each_kind():
    assert list(RECIPES) == ["term", "robot", "task", "transform", "algorithm"]


def test_the_task_with_the_robot_keeps_the_contract(env):
    check_env(env)


def test_the_term_is_the_sum_of_absolute_velocities(env):
    rollout_ET = env.rollout(5)
    velocity_ET = rollout_ET["next", "actor"][..., 1]
    step_dt = 4 * 0.002
    torch.testing.assert_close(rollout_ET["next", "reward"][..., 0], -velocity_ET.abs() * step_dt)


def test_a_field_of_the_robot_reaches_its_model(contributed):
    assert contributed.Swing(mass=0.5).spec().compile().body("arm").mass[0] == 0.5


def test_the_transform_keeps_signs(contributed):
    env = MaskedTransformedEnv(CounterEnv(), [contributed.ObservationSign(["count"])])
    check_env(env)
    assert env.rollout(3)["next", "count"].unique().tolist() == [1.0]


def test_the_algorithm_is_found_by_name_and_trains(contributed, env, tmp_path):
    algorithms.register(contributed.A2C)
    try:
        assert algorithms.algorithm("a2c") is contributed.A2C
        cfg = RunCfg(
            task_name="swing_hold",
            task=env.base_env.cfg,
            num_envs=4,
            objective=contributed.A2CCfg(),
            data=DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=1),
            trainer=TrainerCfg(num_iterations=2, eval_episodes=0, video=False),
        )
        trainer = build(cfg)
        before = [parameter.clone() for parameter in trainer.update.actor.parameters()]
        trainer.train()
        after = trainer.update.actor.parameters()
        assert any((one != other).any() for one, other in zip(after, before, strict=True))
    finally:
        del algorithms.registry._found["a2c"]
