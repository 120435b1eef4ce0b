"""Weights, scale and sums of rewards, on the puck whose positions are known."""

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView
from ksim_rl.envs.term import RewardTerm
from tests.envs.probe_env import DT, Position, puck_env_in_c, push

SPEED_E = torch.tensor([1.0, 2.0, 3.0])


@dataclass(frozen=True, kw_only=True)
class Counted(RewardTerm):
    """One, and a count of how often it was asked."""

    calls: ClassVar[list[int]] = []

    def __call__(self, view: EnvView) -> Tensor:
        self.calls.append(1)
        return torch.ones(view.num_envs)


@dataclass(frozen=True, kw_only=True)
class Column(RewardTerm):
    """Returns [E, 1] instead of [E]."""

    def __call__(self, view: EnvView) -> Tensor:
        return view.joint_pos_EL


def test_terms_are_weighted_scaled_and_summed():
    rewards = {"once": Position(), "minus_twice": Position(weight=-2.0), "one": Counted(weight=0.5)}
    env = puck_env_in_c(limit=None, rewards=rewards)
    next_E = push(env, env.reset())["next"]
    torch.testing.assert_close(next_E["reward"][:, 0], (-SPEED_E * DT + 0.5) * DT)


def test_a_term_of_weight_zero_is_not_computed():
    Counted.calls.clear()
    env = puck_env_in_c(limit=None, rewards={"off": Counted(weight=0.0), "position": Position()})
    push(env, env.reset())
    assert not Counted.calls and "reward/off" not in env.episode_log()


def test_without_rewards_the_reward_is_zero():
    env = puck_env_in_c(limit=None, rewards={})
    next_E = push(env, env.reset())["next"]
    assert next_E["reward"].shape == (3, 1) and next_E["reward"].eq(0.0).all()


def test_a_shape_other_than_one_per_env_is_refused_at_construction():
    with pytest.raises(
        ValueError,
        match=r"'column' returns torch\.float32 \(3, 1\): expected any real dtype \(3,\), one value",
    ):
        puck_env_in_c(rewards={"column": Column()})


@pytest.mark.parametrize("weight", [float("nan"), float("inf"), True, "1"])
def test_a_weight_must_be_a_finite_number(weight):
    with pytest.raises(ValueError, match="weight="):
        Position(weight=weight)
