"""Conditions that end an episode, bool [E]."""

import math
from dataclasses import dataclass

from torch import Tensor

from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import TerminationTerm
from ksim_rl.envs.view import EnvView


@dataclass(frozen=True, kw_only=True)
class TimeOut(TerminationTerm):
    """The episode has lasted `episode_length_s`: a truncation, not a failure."""

    time_out: bool = True

    def __call__(self, view: EnvView) -> Tensor:
        """Return which envs end, bool [E]."""
        return view.episode_step_E + view.time_out_offset_E >= view.max_episode_length


@dataclass(frozen=True, kw_only=True)
class BadOrientation(TerminationTerm):
    """The root is tilted further than a limit: the angle between its z axis and the world's; position stage.

    Attributes:
        limit_angle: rad, in (0, pi).
    """

    limit_angle: float

    def __post_init__(self) -> None:
        check_in_range("limit_angle", self.limit_angle, low=0.0, high=math.pi, low_open=True)

    def __call__(self, view: EnvView) -> Tensor:
        """Return which envs end, bool [E]."""
        # The cosine falls as the angle grows, so comparing cosines needs no acos, which is ill-conditioned at 0.
        return -view.projected_gravity_EL[:, 2] < math.cos(self.limit_angle)


@dataclass(frozen=True, kw_only=True)
class RootHeightBelow(TerminationTerm):
    """The root body's frame is lower than a height in the world frame, m; position stage."""

    minimum_height: float

    def __call__(self, view: EnvView) -> Tensor:
        """Return which envs end, bool [E]."""
        return view.root_pos_EL[:, 2] < self.minimum_height
