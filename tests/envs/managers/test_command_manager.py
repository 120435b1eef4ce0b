"""Commands: clocks, who resamples when, and which command rewards and observations see."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView, ObservationGroupCfg, ObservationTermCfg
from ksim_rl.envs.term import CommandTerm, RewardTerm
from ksim_rl.mdp import Command
from tests.envs.probe_env import DT, Target, puck_env_in_c, push


@dataclass(frozen=True, kw_only=True)
class Flat(CommandTerm):
    """Returns [E] instead of [E, K]."""

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        pass

    def __call__(self, view: EnvView) -> Tensor:
        return torch.zeros(view.num_envs)


@dataclass(frozen=True, kw_only=True)
class CommandItself(RewardTerm):
    """The command "target"."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.command("target")[:, 0]


def commanded(low, high=None, **fields):
    command = Target(resampling_time_range_s=(low, low if high is None else high))
    return puck_env_in_c(limit=None, commands={"target": command}, **fields)


def targets(env, steps):
    """Return the command that each step's policy sees, and the one after the last step, [steps + 1, E]."""
    root_E = env.reset()
    seen = [root_E["command", "target"][:, 0].clone()]
    for _ in range(steps):
        root_E = push(env, root_E)["next"].clone()
        seen.append(root_E["command", "target"][:, 0].clone())
    return torch.stack(seen)


@pytest.mark.parametrize("steps", [1, 7, 25])
def test_a_command_of_n_steps_lasts_n_steps(steps):
    seen = targets(commanded(steps * DT), 2 * steps + 1)
    changed = (seen[1:] != seen[:-1]).all(-1)
    assert changed.nonzero().flatten().tolist() == [
        n for n in range(2 * steps + 1) if (n + 1) % steps == 0
    ]


def test_each_env_has_a_clock_of_its_own():
    seen = targets(commanded(2 * DT, 20 * DT), 60)
    changes_E = (seen[1:] != seen[:-1]).sum(0)
    assert (changes_E >= 2).all() and (changes_E <= 30).all()
    assert not torch.equal(seen[1:, 0] != seen[:-1, 0], seen[1:, 1] != seen[:-1, 1])


def test_the_reward_is_of_the_command_that_the_policy_saw():
    env = commanded(DT, rewards={"itself": CommandItself()}, scale_rewards_by_dt=False)
    root_E = env.reset()
    for _ in range(3):
        seen = root_E["command", "target"].clone()
        next_E = push(env, root_E)["next"].clone()
        assert torch.equal(next_E["reward"], seen)
        assert not torch.isclose(next_E["command", "target"], seen).any()
        root_E = next_E


def test_time_left_is_per_env_and_counts_down():
    env = commanded(5 * DT, 50 * DT)
    root_E = env.reset()
    before = env.command_manager.time_left("target").clone()
    assert len(before.unique()) == 3 and (before >= 5 * DT).all() and (before <= 50 * DT).all()
    push(env, root_E)
    torch.testing.assert_close(env.command_manager.time_left("target"), before - DT)


def test_a_partial_reset_draws_for_its_rows_only():
    env = commanded(5 * DT, 50 * DT)
    before = env.reset()["command", "target"].clone()
    clocks = env.command_manager.time_left("target").clone()
    after = env.reset(env_ids=[2])["command", "target"]
    assert torch.equal(after[:2], before[:2]) and after[2] != before[2]
    assert torch.equal(env.command_manager.time_left("target")[:2], clocks[:2])
    assert env.command_manager.time_left("target")[2] != clocks[2]


def test_an_observation_of_the_command_is_the_commands_copy():
    terms = {"target": ObservationTermCfg(term=Command(command="target"))}
    env = commanded(DT, observations={"actor": ObservationGroupCfg(terms=terms)})
    root_E = env.reset()
    for _ in range(3):
        assert torch.equal(root_E["obs", "target"], root_E["command", "target"])
        root_E = push(env, root_E)["next"].clone()


def test_a_command_is_a_vector_per_env():
    with pytest.raises(
        ValueError, match=r"command term 'flat' returns shape \(3,\): expected \[3, K\]"
    ):
        puck_env_in_c(commands={"flat": Flat(resampling_time_range_s=(1.0, 1.0))})


def test_an_unordered_range_is_refused():
    with pytest.raises(ValueError, match="resampling_time_range_s"):
        Target(resampling_time_range_s=(2.0, 1.0))
