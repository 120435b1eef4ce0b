"""Observation terms of the root, of sensors, actions and commands: clean readings, float32 [E, L].

Noise, delay and history are transforms. Others: `observations_joints`, `observations_bodies`, `observations_contacts`,
`observations_time`.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ksim_rl.checks import check_choice, check_in_range
from ksim_rl.envs.term import ObservationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.target_pose import FRAMES

# -- root --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class RootObservation(ObservationTerm):
    """What the terms of a root share.

    Attributes:
        entity: the robot or object that is meant; "" is the first robot.
    """

    entity: str = ""


@dataclass(frozen=True, kw_only=True)
class RootPos(RootObservation):
    """Position of the root body's frame in the world, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.entity(self.entity).root_pos_EL


@dataclass(frozen=True, kw_only=True)
class RootQuat(RootObservation):
    """Orientation of the root body, body to world, (w, x, y, z), [E, 4]; position stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.entity(self.entity).root_quat_EL


@dataclass(frozen=True, kw_only=True)
class RootRotation6d(RootObservation):
    """The root body's x axis, then its y axis, in the world, [E, 6]; position stage.

    An orientation without jumps (Zhou et al. 2019).
    """

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.entity(self.entity).root.axes_E33[:, :2].flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class RootVelocity(RootObservation):
    """What the terms of a root's velocity share.

    Attributes:
        frame: the axes in which it is given: the root's own, or the world's.
    """

    frame: Literal["root", "world"] = "root"

    def __post_init__(self) -> None:
        check_choice("frame", self.frame, FRAMES)


@dataclass(frozen=True, kw_only=True)
class RootLinVel(RootVelocity):
    """Linear velocity of the root body's frame origin, m/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        entity = view.entity(self.entity)
        return entity.root_lin_vel_b_EL if self.frame == "root" else entity.root_lin_vel_w_EL


@dataclass(frozen=True, kw_only=True)
class RootAngVel(RootVelocity):
    """Angular velocity of the root body, rad/s, [E, 3]; velocity stage."""

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        entity = view.entity(self.entity)
        return entity.root_ang_vel_b_EL if self.frame == "root" else entity.root_ang_vel_w_EL


@dataclass(frozen=True, kw_only=True)
class ProjectedGravity(RootObservation):
    """Direction of gravity (world -z) in the root's frame, a unit vector, [E, 3]; (0, 0, -1) when upright.

    Position stage. Dead time, as of a bus, is the business of the group's delay.

    Attributes:
        time_constant: s, of a first-order lag, as the attitude filter of an IMU has; 0 for none. A reset fills the
            filter with the new orientation.
    """

    time_constant: float = 0.0

    def __post_init__(self) -> None:
        check_in_range("time_constant", self.time_constant, low=0.0)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
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


# -- sensors, action, command ------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SensorReading(ObservationTerm):
    """The reading of an MJCF sensor by name, [E, dim], with the frame, unit and stage of that sensor.

    A gyro or velocimeter reads at its site, in the site's frame, at the velocity stage.
    """

    sensor: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.sensor(self.sensor)


@dataclass(frozen=True, kw_only=True)
class LastAction(ObservationTerm):
    """The action that led to the current state, as the policy gave it, [E, K]; zero after a reset.

    Earlier ones: the history of the group's term.
    """

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.action_EL


@dataclass(frozen=True, kw_only=True)
class Command(ObservationTerm):
    """A command by name, [E, K]."""

    command: str

    def __call__(self, view: EnvView) -> Tensor:
        """Return the reading."""
        return view.command(self.command)
