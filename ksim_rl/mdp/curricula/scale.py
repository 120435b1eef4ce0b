"""These curricula change ranges of commands and weights of rewards, by stages of env steps or with `view.level`.

All change what they change only when envs reset. Those that follow the level stand after the term that drives it, if
they are to follow it in the same reset.
"""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checks import check_in_range, check_pair, unknown_name
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant

Ranges = Mapping[str, tuple[float, float]]


@dataclass(frozen=True, kw_only=True)
class RewardWeight(CurriculumTerm):
    """A curriculum of a reward's weight, which is also the reported level.

    Attributes:
        reward: its name.
    """

    reward: str

    @property
    def adapted_rewards(self) -> tuple[str, ...]:
        return (self.reward,)

    @abstractmethod
    def weight(self, view: EnvView, held: Float[Tensor, ""]) -> Float[Tensor, ""]:
        """Return the weight that the reward should have; `held` is its present one."""

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        held = view.reward_weights[self.reward]
        held.copy_(torch.where(mask_E.any(), self.weight(view, held), held))
        return held.clone()


@dataclass(frozen=True, kw_only=True)
class RewardWeightByStage(RewardWeight):
    """Gives a reward another weight from certain env steps on; until the first stage it has its own.

    Attributes:
        stages: weights by the env step (since the env was seeded) from which on they hold.
    """

    stages: Mapping[int, float]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_steps(self.stages)
        for step, weight in self.stages.items():
            check_in_range(f"stages.{step}", weight)

    def weight(self, view: EnvView, held: Float[Tensor, ""]) -> Float[Tensor, ""]:
        for step, value in sorted(self.stages.items()):
            held = torch.where(view.step_count >= step, float(value), held)
        return held


@dataclass(frozen=True, kw_only=True)
class RewardWeightByLevel(RewardWeight):
    """Moves a reward's weight linearly with `view.level`.

    Attributes:
        start, end: the weights at level 0 and at level 1.
    """

    start: float
    end: float

    def weight(self, view: EnvView, held: Float[Tensor, ""]) -> Float[Tensor, ""]:
        return self.start + (self.end - self.start) * view.level


@dataclass(frozen=True, kw_only=True)
class CommandRangesByStage(CurriculumTerm):
    """Gives a command other ranges from certain env steps on; until the first stage it has its own.

    The reported level is the number of stages that have begun.

    Attributes:
        command: its name.
        stages: ranges by field of the command, by the env step (since the env was seeded) from which on they hold. A
            field that a stage leaves out stays as it is.
    """

    command: str
    stages: Mapping[int, Ranges]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_steps(self.stages)
        for step, ranges in self.stages.items():
            _check_ranges(f"stages.{step}", ranges)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        """Adapt and return the number of the stage."""
        held = _ranges_of(view, self.command, {field for ranges in self.stages.values() for field in ranges})
        wanted = dict(held)
        for step, ranges in sorted(self.stages.items()):
            for field, pair in ranges.items():
                wanted[field] = torch.where(
                    view.step_count >= step, constant(pair, view.device), wanted[field]
                )
        for field, held_2 in held.items():
            held_2.copy_(torch.where(mask_E.any(), wanted[field], held_2))
        stage = (view.step_count >= constant(sorted(self.stages), view.device)).sum().to(torch.float32)
        held_stage = view.shared("stage", 0.0)
        held_stage.copy_(torch.where(mask_E.any(), stage, held_stage))
        return held_stage.clone()


@dataclass(frozen=True, kw_only=True)
class CommandRangesByLevel(CurriculumTerm):
    """Moves the ranges of a command linearly with `view.level`, which is also the reported level.

    Attributes:
        command: its name.
        start, end: ranges by field of the command at level 0 and at level 1; the same fields in both.
    """

    command: str
    start: Ranges
    end: Ranges

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_ranges("start", self.start)
        _check_ranges("end", self.end)
        if self.start.keys() != self.end.keys():
            raise ValueError(
                f"start has the fields {sorted(self.start)} and end {sorted(self.end)}: give the same"
            )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        for field, held_2 in _ranges_of(view, self.command, self.start).items():
            start_2, end_2 = constant(self.start[field], view.device), constant(self.end[field], view.device)
            held_2.copy_(torch.where(mask_E.any(), torch.lerp(start_2, end_2, view.level), held_2))
        return view.level.clone()


def _check_steps(stages: Mapping[int, object]) -> None:
    if not stages:
        raise ValueError("stages={}: give at least one, by the env step at which it begins")
    for step in stages:
        check_in_range("stages (the env step of one)", step, low=0)


def _check_ranges(where: str, ranges: Ranges) -> None:
    if not ranges:
        raise ValueError(f"{where}={{}}: name at least one field of the command")
    for field, pair in ranges.items():
        check_pair(f"{where}.{field}", pair)


def _ranges_of(view: EnvView, command: str, fields: Iterable[str]) -> dict[str, Tensor]:
    """Return the present ranges of some fields of a command, (low, high) [2] each."""
    if command not in view.command_ranges:
        raise unknown_name("command with ranges", command, view.command_ranges)
    present = view.command_ranges[command]
    for field in fields:
        if field not in present:
            raise unknown_name(f"range of the command {command!r}", field, present)
    return {field: present[field] for field in present if field in set(fields)}
