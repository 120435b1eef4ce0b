"""These curricula drive `view.level`, the one difficulty in [0, 1] that ranges, weights and noise may scale with.

An env has at most one of them. All move the level only when envs reset.
"""

from abc import abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Count, Share, WholeNumber
from ksim_rl.checks import check_in_range, unknown_name
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.mdp.quantities import distance_from_origin


@dataclass(frozen=True, kw_only=True)
class LevelCurriculum(CurriculumTerm):
    """What the terms of this file share.

    Attributes:
        initial_level: of an env that has just been built.
    """

    initial_level: Share = 0.0

    @property
    def first_level(self) -> float:
        return self.initial_level


@dataclass(frozen=True, kw_only=True)
class LinearLevel(LevelCurriculum):
    """The level rises linearly to 1 between two counts of env steps.

    Attributes:
        begin_step, end_step: env steps since the env was seeded.
    """

    begin_step: WholeNumber = 0
    end_step: int

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("end_step", self.end_step, low=self.begin_step, low_open=True)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        share = (view.step_count - self.begin_step) / (self.end_step - self.begin_step)
        level = self.initial_level + (1.0 - self.initial_level) * share.clamp(0.0, 1.0)
        view.level.copy_(torch.where(mask_E.any(), level.to(torch.float32), view.level))
        return view.level.clone()


@dataclass(frozen=True, kw_only=True)
class SteppedLevel(LevelCurriculum):
    """The level moves by 1 / `num_levels` whenever the mean score of the last episodes is high or low enough.

    Attributes:
        raise_above: a mean score above this makes it harder.
        lower_below: a mean score below this makes it easier; None never does.
        num_levels: how many steps lead from 0 to 1.
        min_episodes: how many episodes must end before the level may move (and again before the next move); None: one
            per env.
    """

    raise_above: float
    lower_below: float | None = None
    num_levels: Count = 10
    min_episodes: Count | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lower_below is not None:
            check_in_range("lower_below", self.lower_below, high=self.raise_above)

    @abstractmethod
    def score(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return how well the running episodes have gone so far, float32 [E]."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        """Take in the episodes that ended, adapt, and return the level."""
        ended_E = mask_E & (view.episode_step_E > 0)
        held_2 = view.shared("episodes_and_score_2", (0.0, 0.0))
        ended_E2 = torch.stack((torch.ones_like(ended_E, dtype=torch.float32), self.score(view)), dim=-1)
        total_2 = held_2 + torch.where(ended_E[:, None], ended_E2, 0.0).sum(0)
        is_enough = total_2[0] >= (self.min_episodes or view.num_envs)
        mean = total_2[1] / total_2[0].clamp(min=1.0)
        move = (mean > self.raise_above).to(torch.float32)
        if self.lower_below is not None:
            move = move - (mean < self.lower_below).to(torch.float32)
        level = (view.level + move / self.num_levels).clamp(0.0, 1.0)
        view.level.copy_(torch.where(is_enough, level, view.level))
        held_2.copy_(torch.where(is_enough, 0.0, total_2))
        return view.level.clone()


@dataclass(frozen=True, kw_only=True)
class EpisodeLengthLevel(SteppedLevel):
    """Moves with how long episodes last: the score is the share of the longest possible one, in [0, 1]."""

    raise_above: float = 0.8

    def score(self, view: EnvView) -> Float[Tensor, " E"]:
        if view.max_episode_length == 0:
            raise ValueError(
                "EpisodeLengthLevel with episode_length_s=0: episodes have no longest length; set one"
            )
        return view.episode_step_E / _longest_E(view)


@dataclass(frozen=True, kw_only=True)
class DistanceLevel(OfEntity, SteppedLevel):
    """Moves with how far robots get: the score is the horizontal distance from the env's origin at the end, m."""

    def score(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the distances, m, [E]."""
        return distance_from_origin(view, self.entity)


@dataclass(frozen=True, kw_only=True)
class SaturationLevel(SteppedLevel):
    """Moves one step when a reward saturates: the score is what the log shows as `reward/<term>`.

    That is the weighted sum over the episode per second of the longest possible one (the plain sum where episodes have
    no limit), so that a term of weight 2 that is always 1 scores 2.

    Attributes:
        reward: its name.
    """

    reward: str

    def score(self, view: EnvView) -> Float[Tensor, " E"]:
        if self.reward not in view.episode_rewards:
            raise unknown_name("reward", self.reward, view.episode_rewards)
        sum_E = view.episode_rewards[self.reward]
        return sum_E if view.max_episode_length == 0 else sum_E / (_longest_E(view) * view.step_dt)


def _longest_E(view: EnvView) -> Tensor:
    """Return how many env steps each running episode can have; first episodes may have been cut short, [E]."""
    return (view.max_episode_length - view.time_out_offset_E).to(torch.float32)
