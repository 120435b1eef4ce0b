"""What other rooms may use of an env, and how they find it."""

from pathlib import Path

import pytest
import torch
from torchrl.envs import PendulumEnv, TransformedEnv

from ksim_rl import envs
from ksim_rl.envs import contract


@pytest.fixture(scope="module")
def cartpole():
    env = envs.make("cartpole_balance", num_envs=2, seed=0)
    yield env
    env.close()


@pytest.mark.parametrize("kind", contract.PARTS)
def test_our_env_has_each_part_and_a_foreign_one_none(cartpole, kind):
    assert contract.part(cartpole, kind) is cartpole.base_env
    assert contract.part(TransformedEnv(cartpole), kind) is cartpole.base_env
    assert contract.part(TransformedEnv(PendulumEnv()), kind) is None


def test_the_parts_work(cartpole):
    clock = contract.part(cartpole, contract.EpisodeClock)
    assert clock.max_episode_length == round(clock.max_episode_length_s / clock.step_dt)
    assert torch.equal(clock.episode_step_E, cartpole.base_env.view.episode_step_E)
    assert "return_sum" in contract.part(cartpole, contract.EpisodeSums).episode_log()
    assert contract.part(cartpole, contract.DifficultyLevels).curriculum_levels() == {}
    assert contract.part(cartpole, contract.SimulatedWorld).world.num_envs == 2
    assert contract.part(cartpole, contract.Pictures).render() is None


def test_what_is_missing_is_said_by_the_name_of_the_env(cartpole):
    assert contract.missing_parts(cartpole) == []
    missing = contract.missing_parts(PendulumEnv())
    assert len(missing) == len(contract.PARTS)
    assert all(line.startswith("PendulumEnv has no ") for line in missing)


def test_a_foreign_env_takes_part_by_registration():
    class Foreign(PendulumEnv):
        def episode_log(self):
            return {"episodes": torch.zeros(())}

        def episode_log_reset_(self):
            pass

    env = Foreign()
    assert contract.part(env, contract.EpisodeSums) is None
    contract.EpisodeSums.register(Foreign)
    assert contract.part(env, contract.EpisodeSums) is env


def test_the_contract_fits_on_one_screen():
    assert len(Path(contract.__file__).read_text().splitlines()) <= 120
