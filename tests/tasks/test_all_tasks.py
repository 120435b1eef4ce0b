"""What holds for every registered task: it survives YAML, and its env passes the checks that users run."""

import pytest
import yaml

from ksim_rl import envs
from ksim_rl.envs import ManagerBasedRlEnvCfg, from_tree, to_tree
from ksim_rl.testing import check_env
from tests.absent_models import skipped_without_models


@pytest.mark.parametrize("name", envs.names())
def test_its_config_survives_yaml(name):
    cfg = envs.task(name).cfg()
    text = yaml.safe_dump(to_tree(cfg, ManagerBasedRlEnvCfg))
    assert from_tree(ManagerBasedRlEnvCfg, yaml.safe_load(text)) == cfg


# What others check is tested where their parts are: a quadruped in tests/integration/test_stock_torchrl.py, a humanoid
# in tests/tracking, a suite in tests/suites. All run in full tests, since they compile kernels of their own.
QUICK = ("cartpole_swingup",)
NAMES = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in envs.names()
]


def test_the_quick_ones_are_tasks():
    assert set(QUICK) <= set(envs.names())


@pytest.mark.parametrize("name", NAMES)
def test_its_env_passes_the_checks(name):
    with skipped_without_models():
        env = envs.make(name, num_envs=2, seed=0)
    check_env(env)
    assert set(env.observation_spec.keys()) >= {"actor", "critic"}, "what trainers read"
    env.close()
