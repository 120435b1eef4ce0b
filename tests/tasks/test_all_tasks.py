"""What holds for every registered task: it survives YAML, and its env passes the checks that users run."""

import pytest
import yaml

from ksim_rl import envs
from ksim_rl.envs import ManagerBasedRlEnvCfg, from_tree, to_tree
from ksim_rl.testing import check_env


@pytest.mark.parametrize("name", envs.names())
def test_its_config_survives_yaml(name):
    cfg = envs.task(name).cfg()
    text = yaml.safe_dump(to_tree(cfg, ManagerBasedRlEnvCfg))
    assert from_tree(ManagerBasedRlEnvCfg, yaml.safe_load(text)) == cfg


# Suites of other packages have tests of their own; these run two of them here, the others in full ones.
QUICK = ("dm_control_cartpole_balance", "playground_pendulum_swingup")
NAMES = [
    pytest.param(name, marks=pytest.mark.full) if envs.task(name).suite and name not in QUICK else name
    for name in envs.names()
]


@pytest.mark.parametrize("name", NAMES)
def test_its_env_passes_the_checks(name):
    try:
        env = envs.make(name, num_envs=2, seed=0)
    except ValueError as error:
        if "menagerie" not in str(error) and "ksim_rl[dm_control]" not in str(error):
            raise
        pytest.skip(str(error))
    check_env(env)
    assert set(env.observation_spec.keys()) >= {"actor", "critic"}, "what trainers read"
    env.close()
