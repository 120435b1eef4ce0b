"""The curricula: they adapt difficulty, and act only when envs reset.

Some drive `view.level`, the one difficulty in [0, 1] that ranges, weights and noise may scale with; an env has at most
one of them. Those that follow the level stand after it, if they are to follow it in the same reset. Others change
ranges of commands and weights of rewards by stages of env steps, or move envs over the levels of a terrain.
"""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.checked import Count, Filled, NonNegative, Range, Share, WholeNumber, Within
from ksim_rl.checks import check_in_range, check_known
from ksim_rl.envs.term import CommandRanges, CurriculumTerm, Fields
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfCommand, OfEntity, distance_from_origin
from ksim_rl.transforms.row_transform import by_level


@dataclass(frozen=True, kw_only=True)
class LevelCurriculum(CurriculumTerm):
    """A curriculum that drives the level; `initial_level` is the level of an env that has just been built."""

    initial_level: Share = 0.0

    @property
    def first_level(self) -> float:
        return self.initial_level


@dataclass(frozen=True, kw_only=True)
class LinearLevel(LevelCurriculum):
    """The level rises linearly to 1 between two counts of env steps since the env was seeded."""

    begin_step: WholeNumber = 0
    end_step: int

    def _check_fields(self) -> None:
        super()._check_fields()
        check_in_range("end_step", self.end_step, low=self.begin_step, low_open=True)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        # The step count is a tensor, so that captured steps see it grow.
        share = (view.step_count - self.begin_step) / (self.end_step - self.begin_step)
        level = self.initial_level + (1.0 - self.initial_level) * share.clamp(0.0, 1.0)
        # Levels change only at resets of some env, on any rank: all ranks must keep the same level.
        changes = ranks.any_of(mask_E)
        view.level.copy_(torch.where(changes, level.to(torch.float32), view.level))
        return view.level.clone()


@dataclass(frozen=True, kw_only=True)
class SteppedLevel(LevelCurriculum):
    """The level moves by 1 / `num_levels` whenever the mean score of the last episodes is high or low enough.

    A mean below `lower_below` makes it easier; None never does. `min_episodes` end before each move; None: one per env.
    """

    raise_above: float
    lower_below: float | None = None
    num_levels: Count = 10
    min_episodes: Count | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.lower_below is not None:
            check_in_range("lower_below", self.lower_below, high=self.raise_above)

    @abstractmethod
    def score(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return how well the running episodes have gone so far, float32 [E]."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        # A reset before the first step ends no episode.
        ended_E = mask_E & (view.episode_step_E > 0)
        held_2 = view.shared("episodes_and_score_2", (0.0, 0.0))
        one_E = torch.ones_like(ended_E, dtype=torch.float32)
        one_and_score_E2 = torch.stack((one_E, self.score(view)), dim=-1)
        # Number of ended episodes, and sum of their scores.
        added_2 = torch.where(ended_E[:, None], one_and_score_E2, 0.0).sum(0)
        # All ranks count together, so that they move at the same moment.
        ranks.sum_(added_2)
        total_2 = held_2 + added_2
        is_enough = total_2[0] >= (self.min_episodes or view.num_envs * ranks.size())
        # The mean is used only where enough episodes have ended; the clamp avoids 0 / 0 elsewhere.
        mean = total_2[1] / total_2[0].clamp(min=1.0)
        step = 1.0 / self.num_levels
        level = torch.where(mean > self.raise_above, view.level + step, view.level)
        if self.lower_below is not None:
            level = torch.where(mean < self.lower_below, level - step, level)
        view.level.copy_(torch.where(is_enough, level.clamp(0.0, 1.0), view.level))
        # The count starts from zero after each move, so that scores of the old level do not count for the new
        # one.
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
        return distance_from_origin(view, self.entity)


@dataclass(frozen=True, kw_only=True)
class SaturationLevel(SteppedLevel):
    """Moves one step when a reward saturates: the score is the number that the log shows as `reward/<term>`.

    It is the weighted sum over the episode per second of the longest possible one (the plain sum where episodes have
    no limit), so that a term of weight 2 that is always 1 scores 2.
    """

    reward: str

    def score(self, view: EnvView) -> Float[Tensor, " E"]:
        check_known("reward", self.reward, view.episode_rewards)
        sum_E = view.episode_rewards[self.reward]
        if view.max_episode_length == 0:
            # Without a longest episode there is no rate to compare with.
            return sum_E
        return sum_E / (_longest_E(view) * view.step_dt)


def _longest_E(view: EnvView) -> Tensor:
    """Return how many env steps each running episode can have; first episodes may have been cut short, [E]."""
    # Staggered first episodes start with some of their steps used up.
    return (view.max_episode_length - view.time_out_offset_E).to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class TerrainLevels(OfCommand, OfEntity, CurriculumTerm):
    """Moves the envs whose episodes ended to other levels of `scene.terrain`, a `TerrainGrid`; reports the mean level.

    An env moves up one level when its robot got at least `up_distance` away from its origin (horizontally, at the end
    of the episode), and down one when it got less than `down_share` of the way that its last command asks for in a
    whole episode, be it that it was slow or that it fell. An env that has mastered the last level goes on at a random
    one, so that none is forgotten. The rule is from Rudin et al., "Learning to walk in minutes", 2022.

    The command is a velocity (vx, vy, ...), m/s; `up_distance` a share of the way from a patch's centre to its edge.
    """

    up_distance: Annotated[float, Within(low=0.0, high=1.0, low_open=True)] = 0.8
    down_share: NonNegative = 0.5

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        terrain = view.terrain
        level_E = terrain.levels_E
        top = terrain.num_levels - 1
        distance_E = distance_from_origin(view, self.entity)
        planar_E2 = view.command(self.command)[:, :2]
        speed_E = torch.linalg.vector_norm(planar_E2, dim=-1)
        # Metres that a robot covers in a whole episode if it follows its last command.
        asked_E = speed_E * (view.max_episode_length * view.step_dt)
        up_E = distance_E >= self.up_distance * terrain.half_width
        # Never both: who got far enough moves up, even if the command asked for more.
        down_E = ~up_E & (distance_E < self.down_share * asked_E)
        moved_E = level_E + up_E.long() - down_E.long()
        share_E = view.uniform(1)[:, 0]
        # The product may round up to `num_levels`, hence the clamp.
        drawn_E = (share_E * terrain.num_levels).long().clamp(max=top)
        next_E = torch.where(moved_E > top, drawn_E, moved_E.clamp(min=0))
        # An env that is reset before its first step has shown nothing, and stays where it is.
        ended_E = mask_E & (view.episode_step_E > 0)
        terrain.set_levels(ended_E, next_E)
        return terrain.levels_E.to(torch.float32).mean()


Ranges = Annotated[Mapping[str, Range], Filled("name at least one field of the command")]
SOME_STAGE = Filled("give at least one, by the env step at which it begins")


@dataclass(frozen=True, kw_only=True)
class RewardWeight(CurriculumTerm):
    """A curriculum of the weight of the named reward, which is also the reported level."""

    reward: str

    @property
    def adapted_rewards(self) -> tuple[str, ...]:
        return (self.reward,)

    @abstractmethod
    def weight(self, view: EnvView, held: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Return the weight that the reward should have; `held` is its present one."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        held = view.reward_weights[self.reward]
        # Weights are shared by all envs, and change in place and at resets only.
        changes = ranks.any_of(mask_E)
        held.copy_(torch.where(changes, self.weight(view, held), held))
        return held.clone()


@dataclass(frozen=True, kw_only=True)
class RewardWeightByStage(RewardWeight):
    """Gives a reward other weights from certain env steps (since the env was seeded) on; until then it has its own."""

    stages: Annotated[Mapping[WholeNumber, float], SOME_STAGE]

    def weight(self, view: EnvView, held: Float[Tensor, ""]) -> Float[Tensor, ""]:
        # In the order of the steps, so that the last stage that has begun wins.
        for step, value in sorted(self.stages.items()):
            held = torch.where(view.step_count >= step, float(value), held)
        return held


def _stages_begun(view: EnvView, stages: Iterable[int]) -> Tensor:
    """Return how many stages have begun, float32 []."""
    # Stages begin in order, so their number is how many starts have passed.
    begins_S = constant(sorted(stages), view.device)
    return (view.step_count >= begins_S).sum().to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class FieldsByStage(CurriculumTerm):
    """A curriculum of fields of a term, whose number of the stages that have begun is the reported level."""

    stages: Annotated[Mapping[WholeNumber, Fields], SOME_STAGE]

    @property
    @abstractmethod
    def adapted(self) -> str:
        """The term, such as "rewards/upright"."""

    @property
    def adapted_fields(self) -> Mapping[str, Sequence[Fields]]:
        return {self.adapted: [fields for _, fields in sorted(self.stages.items())]}

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        stage = _stages_begun(view, self.stages)
        held = view.stages[self.adapted]
        # At resets only, so that an episode is rated by one rule.
        held.copy_(torch.where(ranks.any_of(mask_E), stage, held))
        return held.clone()


@dataclass(frozen=True, kw_only=True)
class RewardFieldsByStage(FieldsByStage):
    """Gives fields of a reward, such as `std`, other values from certain env steps (since the env was seeded) on.

    A field that a stage leaves out stays as it is. The reward is computed for each stage, so that it costs as much as
    that many terms. Its weight is the business of `RewardWeightByStage`.
    """

    reward: str

    @property
    def adapted(self) -> str:
        return f"rewards/{self.reward}"


@dataclass(frozen=True, kw_only=True)
class TerminationFieldsByStage(FieldsByStage):
    """Gives fields of a termination, such as a limit, other values from certain env steps on.

    Stages are as in `RewardFieldsByStage`; `time_out` stays as it is.
    """

    termination: str

    @property
    def adapted(self) -> str:
        return f"terminations/{self.termination}"


@dataclass(frozen=True, kw_only=True)
class RewardWeightByLevel(RewardWeight):
    """Moves a reward's weight linearly with `view.level` from `start` at level 0 to `end` at level 1."""

    start: float
    end: float

    def weight(self, view: EnvView, held: Float[Tensor, ""]) -> Float[Tensor, ""]:
        return by_level(self.start, self.end, view.level)


@dataclass(frozen=True, kw_only=True)
class CommandRangesByStage(OfCommand, CurriculumTerm):
    """Gives a command other ranges from certain env steps on; until the first stage it has its own.

    Stages begin at env steps since the env was seeded; a field of the command that a stage leaves out stays as it is.
    The reported level is the number of stages that have begun.
    """

    stages: Annotated[Mapping[WholeNumber, Ranges], SOME_STAGE]

    def command_ranges(self, step_count: int) -> Mapping[str, Sequence[CommandRanges]]:
        begun = [ranges for step, ranges in self.stages.items() if step <= step_count]
        return {self.command: begun}

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        fields: set[str] = set()
        fields.update(*self.stages.values())
        held = _ranges_of(view, self.command, fields)
        changes = ranks.any_of(mask_E)
        for step, ranges in sorted(self.stages.items()):
            begins = changes & (view.step_count >= step)
            for field, pair in ranges.items():
                # In place: the command reads these tensors.
                wanted_2 = constant(pair, view.device)
                held[field].copy_(torch.where(begins, wanted_2, held[field]))
        stage = _stages_begun(view, self.stages)
        held_stage = view.shared("stage", 0.0)
        held_stage.copy_(torch.where(changes, stage, held_stage))
        return held_stage.clone()


@dataclass(frozen=True, kw_only=True)
class CommandRangesByLevel(OfCommand, CurriculumTerm):
    """Moves the ranges of a command linearly from `start` at `view.level` 0, which is also reported, to `end` at 1."""

    start: Ranges
    end: Ranges

    def command_ranges(self, step_count: int) -> Mapping[str, Sequence[CommandRanges]]:
        # The level that was reached is not known here.
        return {self.command: [self.start, self.end]}

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.start.keys() != self.end.keys():
            raise ValueError(
                f"start has the fields {sorted(self.start)} and end {sorted(self.end)}: give the same"
            )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        changes = ranks.any_of(mask_E)
        # `by_level` mixes both ends; the level is a tensor that captured steps read.
        for field, held_2 in _ranges_of(view, self.command, self.start).items():
            start_2 = constant(self.start[field], view.device)
            end_2 = constant(self.end[field], view.device)
            held_2.copy_(torch.where(changes, by_level(start_2, end_2, view.level), held_2))
        return view.level.clone()


def _ranges_of(view: EnvView, command: str, fields: Iterable[str]) -> dict[str, Tensor]:
    """Return the present ranges of some fields of a command, (low, high) [2] each."""
    check_known("command with ranges", command, view.command_ranges)
    # The present ranges are live tensors, shared with the command.
    present = view.command_ranges[command]
    for field in fields:
        check_known(f"range of the command {command!r}", field, present)
    return {field: present[field] for field in present if field in set(fields)}
