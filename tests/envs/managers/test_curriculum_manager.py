"""Curricula: they run for the rows that reset, and what they change takes effect inside the next step."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from ksim_rl.envs import EnvView
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.testing import count_syncs
from tests.envs.probe_env import DT, Position, puck_env, push


@dataclass(frozen=True, kw_only=True)
class WeightByEpisodes(CurriculumTerm):
    """The reward's weight is the number of episodes that have begun in all envs together, less the first ones."""

    reward: str = "position"

    @property
    def adapted_rewards(self) -> tuple[str, ...]:
        return (self.reward,)

    def __call__(self, view: EnvView, mask_E: Tensor) -> Tensor:
        episodes_E = view.buffer("episodes_E", keep=True)
        episodes_E.add_(mask_E)
        level = (episodes_E - 1.0).clamp(min=0.0).sum()
        if self.reward in view.reward_weights:
            view.reward_weights[self.reward].copy_(level)
        return level


@dataclass(frozen=True, kw_only=True)
class PerEnv(CurriculumTerm):
    """Returns [E] instead of []."""

    def __call__(self, view: EnvView, mask_E: Tensor) -> Tensor:
        return mask_E.float()


def ramp_env(**fields):
    return puck_env(
        limit=None,
        episode_length_s=2 * DT,
        rewards={"position": Position(weight=0.0)},
        curriculum={"ramp": WeightByEpisodes()},
        **fields,
    )


def rollout(env, steps):
    root_E, rewards = env.reset(), []
    for _ in range(steps):
        env_state_E, root_E = env.step_and_maybe_reset(root_E.set("action", torch.zeros(3, 1)))
        rewards.append(env_state_E["next", "reward"][:, 0].clone())
    return torch.stack(rewards)


def test_a_weight_changes_from_the_step_after_the_reset():
    env = ramp_env()
    weights = [
        0.0,
        0.0,
        3.0,
        3.0,
        6.0,
        6.0,
        9.0,
    ]  # three envs begin another episode every two steps
    speed_E = torch.tensor([1.0, 2.0, 3.0])
    expected = torch.stack(
        [weight * speed_E * DT * (1 + k % 2) * DT for k, weight in enumerate(weights)]
    )
    torch.testing.assert_close(rollout(env, 7), expected)
    assert env.curriculum_levels()["ramp"] == 9.0


def test_an_adapted_reward_of_weight_zero_is_computed_and_logged():
    env = ramp_env()
    assert "reward/position" in env.episode_log()
    other = puck_env(rewards={"position": Position(weight=0.0)})
    assert "reward/position" not in other.episode_log()


def test_only_rows_that_reset_count():
    env = ramp_env()
    env.reset()
    env.reset(env_ids=[1])
    assert env.curriculum_levels()["ramp"] == 1.0
    push(env, env.reset(env_ids=[]))
    assert env.curriculum_levels()["ramp"] == 1.0


def test_weights_and_levels_are_part_of_the_state():
    env, other = ramp_env(), ramp_env()
    rollout(env, 4)
    other.load_state_dict(env.state_dict())
    assert other.curriculum_levels()["ramp"] == 6.0
    assert other.view.reward_weights["position"] == 6.0


def test_curricula_never_make_the_host_wait():
    env = ramp_env()
    root_E, action = env.reset(), torch.zeros(3, 1)
    with count_syncs() as syncs:
        for _ in range(5):
            _, root_E = env.step_and_maybe_reset(root_E.set("action", action))
    assert syncs.total == 0, syncs.report()


def test_an_adapted_reward_must_exist():
    with pytest.raises(ValueError, match="unknown reward 'positon': did you mean 'position'"):
        puck_env(curriculum={"ramp": WeightByEpisodes(reward="positon")})


def test_a_level_is_one_for_all_envs():
    with pytest.raises(
        ValueError, match=r"curriculum term 'rows' returns shape \(3,\): expected \(\)"
    ):
        puck_env(curriculum={"rows": PerEnv()})
