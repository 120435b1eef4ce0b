"""This module lets the targets of another actuator arrive late."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checked import WholeNumber
from ksim_rl.scene.actuators.actuator import Actuator, Drive, Law, SubstepRing
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.joint_targets import JointState, JointTarget, TargetKind


@dataclass(frozen=True, kw_only=True)
class DelayedActuator(Actuator):
    """Another actuator, built-in or explicit, that sees its targets some physics substeps late.

    The lag is drawn for each env when that env resets, uniformly from {min_lag, ..., max_lag}, one for all joints of
    this entry. Until an episode's first target arrives, it counts as having been there before.

    Attributes:
        actuator: what is driven late.
        min_lag, max_lag: physics substeps, both included. With lag k the first k substeps after a change of the target
            still see the old one.
    """

    is_explicit: ClassVar[bool] = True  # built-in actuators too get their control before each substep

    actuator: Actuator
    min_lag: WholeNumber = 0
    max_lag: WholeNumber

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_lag > self.max_lag:
            raise ValueError(f"min_lag={self.min_lag} exceeds max_lag={self.max_lag}")

    @property
    def driven(self) -> Patterns:
        """The joints of the actuator inside."""
        return self.actuator.driven

    @property
    def takes(self) -> frozenset[TargetKind]:
        """What the actuator inside takes."""
        return self.actuator.takes

    @property
    def params(self) -> Mapping[str, float]:
        """Those of the actuator inside."""
        return self.actuator.params

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Set up the actuator inside."""
        self.actuator.configure(actuator, joint)

    def law(self, drive: Drive) -> Law:
        """Return the law inside, on targets of some substeps ago."""
        inner = self.actuator.law(drive)
        lag_E = drive.buffer("lag_E", dtype=torch.int64, keep=True)
        fields = [f"{kind}_EN" for kind in sorted(self.takes)]
        ring = SubstepRing(drive, "targets", self.max_lag + 1, len(fields) * drive.num_joints)

        def draw(mask_E: Bool[Tensor, " E"]) -> None:
            drawn_E = drive.integers(1, self.min_lag, self.max_lag)[:, 0]
            lag_E.copy_(torch.where(mask_E, drawn_E, lag_E))

        def late_EN(state: JointState, target: JointTarget) -> Tensor:
            ring.push(torch.cat([getattr(target, field) for field in fields], dim=1))
            arrived = ring.at_rows(lag_E).chunk(len(fields), dim=1)
            return inner(state, target._replace(**dict(zip(fields, arrived, strict=True))))

        drive.on_reset(draw)
        return late_EN
