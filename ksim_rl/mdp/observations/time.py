"""These observations read how long the episode has lasted and how much of it is left."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant


@dataclass(frozen=True, kw_only=True)
class EpisodeTime(ObservationTerm):
    """Time since the start of the episode, s, [E, 1]."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.episode_time_E[:, None]


@dataclass(frozen=True, kw_only=True)
class RemainingTime(ObservationTerm):
    """Time until the episode times out (`TimeOut`), s, [E, 1]. Needs `episode_length_s`.

    Envs that are not made of terms have `TimeAwareObservation`, which counts steps itself.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        if view.max_episode_length == 0:
            raise ValueError(
                "RemainingTime with episode_length_s=0: episodes never time out; set episode_length_s"
            )
        left_E = view.max_episode_length - view.episode_step_E - view.time_out_offset_E
        return left_E.to(torch.float32)[:, None] * view.step_dt


@dataclass(frozen=True, kw_only=True)
class Clock(ObservationTerm):
    """sin, then cos, of the angles 2 pi (frequency t + phase), `t` the episode's time, [E, 2P].

    Attributes:
        frequency: Hz.
        phases: P offsets in cycles, one per foot, say; (0.0, 0.5) are in antiphase.
    """

    frequency: Positive
    phases: tuple[float, ...] = (0.0,)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.phases:
            raise ValueError("phases=(): give at least one, such as (0.0,)")

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        offsets_P = constant([2.0 * math.pi * phase for phase in self.phases], view.device)
        angle_EP = view.episode_time_E[:, None] * (2.0 * math.pi * self.frequency) + offsets_P
        return torch.cat((angle_EP.sin(), angle_EP.cos()), dim=-1)
