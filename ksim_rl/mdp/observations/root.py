"""These observations read a root, a sensor of the MJCF, the last action, commands and the time in the episode."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import InFrame, OfEntity


@dataclass(frozen=True, kw_only=True)
class RootPos(OfEntity, ObservationTerm):
    """Position of the root body's frame in the world, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.entity(self.entity).root_pos_EL


@dataclass(frozen=True, kw_only=True)
class RootQuat(OfEntity, ObservationTerm):
    """Orientation of the root body, body to world, (w, x, y, z), [E, 4]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.entity(self.entity).root_quat_EL


@dataclass(frozen=True, kw_only=True)
class RootRotation6d(OfEntity, ObservationTerm):
    """The root body's x axis, then its y axis, in the world, [E, 6]; position stage.

    An orientation without jumps (Zhou et al. 2019).
    """

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.entity(self.entity).root.axes_E33[:, :2].flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class RootLinVel(InFrame, ObservationTerm):
    """Linear velocity of the root body's frame origin, in the axes of `frame`, m/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        entity = view.entity(self.entity)
        return entity.root_lin_vel_b_EL if self.frame == "root" else entity.root_lin_vel_w_EL


@dataclass(frozen=True, kw_only=True)
class RootAngVel(InFrame, ObservationTerm):
    """Angular velocity of the root body, in the axes of `frame`, rad/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        entity = view.entity(self.entity)
        return entity.root_ang_vel_b_EL if self.frame == "root" else entity.root_ang_vel_w_EL


@dataclass(frozen=True, kw_only=True)
class ProjectedGravity(OfEntity, ObservationTerm):
    """Direction of gravity (world -z) in the root's frame, a unit vector, [E, 3]; (0, 0, -1) when upright.

    Position stage. Dead time, as of a bus, is the business of the group's delay.

    Attributes:
        time_constant: s, of a first-order lag, as the attitude filter of an IMU has; 0 for none. A reset fills the
            filter with the new orientation.
    """

    time_constant: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        gravity_E3 = view.entity(self.entity).projected_gravity_EL
        if self.time_constant == 0.0:
            return gravity_E3
        # Readings are also taken when other rows reset: the filter moves on only if an env step has passed.
        steps_E, filtered_E3 = view.buffer("steps_E", dtype=torch.int64), view.buffer("filtered_E3", 3)
        now_E = view.episode_step_E + 1
        gain = 1.0 - math.exp(-view.step_dt / self.time_constant)
        gain_E = torch.where(steps_E == 0, 1.0, torch.where(steps_E == now_E, 0.0, gain))
        filtered_E3.lerp_(gravity_E3, gain_E[:, None])
        steps_E.copy_(now_E)
        return torch.nn.functional.normalize(filtered_E3, dim=-1)


@dataclass(frozen=True, kw_only=True)
class SensorReading(ObservationTerm):
    """The reading of an MJCF sensor by name, [E, dim], with the frame, unit and stage of that sensor.

    A gyro or velocimeter reads at its site, in the site's frame, at the velocity stage.
    """

    sensor: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.sensor(self.sensor)


@dataclass(frozen=True, kw_only=True)
class LastAction(ObservationTerm):
    """The action that led to the current state, as the policy gave it, [E, K]; zero after a reset.

    Earlier ones: the history of the group's term.
    """

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.action_EL


@dataclass(frozen=True, kw_only=True)
class Command(ObservationTerm):
    """A command by name, [E, K]."""

    command: str

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return view.command(self.command)


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
