"""This module has motors with a proportional-derivative controller, ideal or with a torque that falls with speed."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.scene.actuators.actuator import Drive, ExplicitActuator, Law
from ksim_rl.scene.state.joint_targets import JointState, JointTarget, TargetKind


@dataclass(frozen=True, kw_only=True)
class IdealPDActuator(ExplicitActuator):
    """Effort = stiffness * (position error) + damping * (velocity error) + effort target, within the effort limit.

    Attributes:
        stiffness: N m / rad or N / m.
        damping: N m s / rad or N s / m.
    """

    stiffness: NonNegative
    damping: NonNegative

    _takes: ClassVar[frozenset[TargetKind]] = frozenset({"pos", "vel", "effort"})

    @property
    def params(self) -> Mapping[str, float]:
        """The gains and the limit."""
        return {**super().params, "stiffness": self.stiffness, "damping": self.damping}

    @property
    def law_key(self) -> Hashable:
        """All joints with this kind of motor are computed at once."""
        return type(self)

    def law(self, drive: Drive) -> Law:
        """Return the controller."""

        def effort_EN(state: JointState, target: JointTarget) -> Float[Tensor, "E N"]:
            limit_EN = drive.param("effort_limit")
            return pd_effort(drive, state, target).clamp(-limit_EN, limit_EN)

        return effort_EN


def pd_effort(drive: Drive, state: JointState, target: JointTarget) -> Float[Tensor, "E N"]:
    """Return what a proportional-derivative controller asks its motors for, without limits, [E, N]."""
    asked_EN = torch.addcmul(target.effort_EN, drive.param("stiffness"), target.pos_EN - state.pos_EN)
    return torch.addcmul(asked_EN, drive.param("damping"), target.vel_EN - state.vel_EN)


@dataclass(frozen=True, kw_only=True)
class DCMotorActuator(IdealPDActuator):
    """A proportional-derivative controller on a motor with a limited voltage.

    At velocity v the voltage allows efforts between `saturation_effort * (-1 - v / velocity_limit)` and
    `saturation_effort * (1 - v / velocity_limit)`: the straight speed-torque line of a brushed or field-oriented motor
    (Lynch and Park, Modern Robotics, 2017, section 8.9.1). The current allows `effort_limit` in both directions. Beyond
    the velocity limit the motor can only brake.

    Attributes:
        saturation_effort: stall effort at full voltage, N m or N.
        velocity_limit: no-load velocity at full voltage, rad/s or m/s.
    """

    saturation_effort: Positive
    velocity_limit: Positive

    @property
    def params(self) -> Mapping[str, float]:
        """The gains, the limit and the two ends of the line."""
        ends = {"saturation_effort": self.saturation_effort, "velocity_limit": self.velocity_limit}
        return {**super().params, **ends}

    def law(self, drive: Drive) -> Law:
        """Return the controller with its motor."""

        def effort_EN(state: JointState, target: JointTarget) -> Tensor:
            stall_EN, limit_EN = drive.param("saturation_effort"), drive.param("effort_limit")
            lost_EN = stall_EN * state.vel_EN / drive.param("velocity_limit")
            highest_EN = (stall_EN - lost_EN).clamp(-limit_EN, limit_EN)
            lowest_EN = (-stall_EN - lost_EN).clamp(-limit_EN, limit_EN)
            return torch.clamp(pd_effort(drive, state, target), lowest_EN, highest_EN)

        return effort_EN
