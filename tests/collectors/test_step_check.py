"""Ranks compare a recorded step by the same number of their own steps, each of which may wait for the others."""

from dataclasses import dataclass

import pytest
import torch

from ksim_rl import envs, ranks
from ksim_rl.collectors.step_check import StepCheck
from ksim_rl.device.group import rank
from ksim_rl.envs.term import RewardTerm
from tests.envs.probe_env import puck_cfg
from tests.ranks.gloo import results


@dataclass(frozen=True, kw_only=True)
class OfAllRanks(RewardTerm):
    """The number of rows of all ranks."""

    def __call__(self, view):
        rows = torch.ones(view.num_envs)
        ranks.sum_(rows)
        return rows


def compared():
    """Return what differs, and the rewards and the number of own steps, where rank 1 has one reward wrong."""
    env = envs.build(puck_cfg(num_envs=4, rewards={"all": OfAllRanks()}, limit=None))
    root_E = env.reset().clone()
    check = StepCheck(env, root_E, env.rand_action(root_E.copy()))
    rewards = []
    step = check.own_step

    def counted():
        env_state_E = step()
        rewards.append(env_state_E["next", "reward"].tolist())
        return env_state_E

    def recorded():
        env_state_E = step()
        env_state_E["next", "reward"][2] += 1.0 * rank()
        return env_state_E

    check.own_step = counted
    return check.differences(recorded), rewards


@pytest.mark.full
def test_a_difference_of_one_rank_is_looked_into_by_all(tmp_path):
    first, second = results(compared, size=2, folder=tmp_path)
    assert first == second
    found, rewards = first
    assert found == ["next.reward in 1 rows"]
    assert len(rewards) > 2
