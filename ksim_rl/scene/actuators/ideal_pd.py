"""This module models a motor with a proportional-derivative controller."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.scene.actuators.actuator import (
    ExplicitActuator,
    JointState,
    JointTarget,
    Law,
    TargetKind,
)
from ksim_rl.scene.actuators.drive import Drive


@dataclass(frozen=True, kw_only=True)
class IdealPDActuator(ExplicitActuator):
    """Effort = stiffness * (position error) + damping * (velocity error) + effort target, within the effort limit.

    Attributes:
        stiffness: N m / rad or N / m.
        damping: N m s / rad or N s / m.
    """

    stiffness: NonNegative
    damping: NonNegative

    @property
    def takes(self) -> frozenset[TargetKind]:
        """All three."""
        return frozenset({"pos", "vel", "effort"})

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
