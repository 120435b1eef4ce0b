"""This module models a motor whose torque falls with its speed."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.scene.actuators.actuator import Law
from ksim_rl.scene.actuators.drive import Drive
from ksim_rl.scene.actuators.ideal_pd import IdealPDActuator, pd_effort
from ksim_rl.scene.state.joint_targets import JointState, JointTarget


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
