"""Motors with a proportional-derivative controller, and targets of any actuator that arrive late."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive, WholeNumber
from ksim_rl.scene.actuators.actuator import Actuator, Drive, ExplicitActuator, Law, SubstepRing
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.joint_control import TargetKind
from ksim_rl.scene.state.joint_targets import JointState, JointTarget


@dataclass(frozen=True, kw_only=True)
class IdealPDActuator(ExplicitActuator):
    """Effort = stiffness * (position error) + damping * (velocity error) + effort target, within the effort limit.

    `stiffness` is in N m / rad or N / m, `damping` in N m s / rad or N s / m.
    """

    takes = frozenset({"pos", "vel", "effort"})

    stiffness: NonNegative
    damping: NonNegative

    @property
    def params(self) -> Mapping[str, float]:
        return {**super().params, "stiffness": self.stiffness, "damping": self.damping}

    @property
    def law_key(self) -> Hashable:
        """All joints with this kind of motor are computed together."""
        return type(self)

    def law(self, drive: Drive) -> Law:
        def effort_EN(state: JointState, target: JointTarget) -> Float[Tensor, "E N"]:
            # Read at each substep: events may change it between worlds.
            limit_EN = drive.param("effort_limit")
            return pd_effort(drive, state, target).clamp(-limit_EN, limit_EN)

        return effort_EN


def pd_effort(drive: Drive, state: JointState, target: JointTarget) -> Float[Tensor, "E N"]:
    """Return the effort that a proportional-derivative controller asks for, without limits."""
    # Effort + kp * (position error) + kd * (velocity error), in two fused kernels.
    asked_EN = torch.addcmul(
        target.effort_EN, drive.param("stiffness"), target.pos_EN - state.pos_EN
    )
    return torch.addcmul(asked_EN, drive.param("damping"), target.vel_EN - state.vel_EN)


@dataclass(frozen=True, kw_only=True)
class DCMotorActuator(IdealPDActuator):
    """A proportional-derivative controller on a motor with a limited voltage.

    At velocity v the voltage allows efforts between `saturation_effort * (-1 - v / velocity_limit)` and
    `saturation_effort * (1 - v / velocity_limit)`: the straight speed-torque line of a brushed or field-oriented motor
    (Lynch and Park, Modern Robotics, 2017, section 8.9.1), from the stall effort (N m or N) to the no-load velocity
    (rad/s or m/s). The current allows `effort_limit` in both directions. Beyond the velocity limit it can only brake.
    """

    saturation_effort: Positive
    velocity_limit: Positive

    @property
    def params(self) -> Mapping[str, float]:
        ends = {"saturation_effort": self.saturation_effort, "velocity_limit": self.velocity_limit}
        return {**super().params, **ends}

    def law(self, drive: Drive) -> Law:
        def effort_EN(state: JointState, target: JointTarget) -> Tensor:
            stall_EN = drive.param("saturation_effort")
            limit_EN = drive.param("effort_limit")
            # Back-EMF: the effort that the voltage loses at this velocity.
            lost_EN = stall_EN * state.vel_EN / drive.param("velocity_limit")
            # Voltage first, then current; beyond the no-load velocity the upper end is negative: it only
            # brakes.
            highest_EN = (stall_EN - lost_EN).clamp(-limit_EN, limit_EN)
            lowest_EN = (-stall_EN - lost_EN).clamp(-limit_EN, limit_EN)
            return torch.clamp(pd_effort(drive, state, target), lowest_EN, highest_EN)

        return effort_EN


def without_delay(actuator: Actuator) -> Actuator:
    """Return the actuator behind a delay; one that is not delayed is returned as it is."""
    return actuator.actuator if isinstance(actuator, DelayedActuator) else actuator


@dataclass(frozen=True, kw_only=True)
class DelayedActuator(Actuator):
    """Another actuator, built-in or explicit, that sees its targets some physics substeps late.

    The lag is drawn for each env when that env resets, uniformly from {min_lag, ..., max_lag}, one for all joints of
    this entry, and of all entries with the same `lag_group`, as on one bus. With lag k the first k substeps after a
    change of the target still see the old one; until an episode's first target arrives, it counts as having been there
    before.
    """

    # Built-in actuators too get their control before each substep.
    is_explicit: ClassVar[bool] = True
    counts_substeps: ClassVar[bool] = True

    actuator: Actuator
    min_lag: WholeNumber = 0
    max_lag: WholeNumber
    lag_group: str = ""
    """Entries of a group, of whichever robot, have one lag in each env, and so the same bounds."""

    def least_numbers(self, num_envs: int) -> Mapping[tuple[str, ...], float]:
        """Return the numbers of the targets that are kept."""
        return {("max_lag",): num_envs * (self.max_lag + 1)}

    def _check_fields(self) -> None:
        super()._check_fields()
        # Equal bounds mean a fixed lag.
        if self.min_lag > self.max_lag:
            raise ValueError(f"min_lag={self.min_lag} exceeds max_lag={self.max_lag}")

    @property
    def driven(self) -> Patterns:
        return self.actuator.driven

    @property
    def takes(self) -> frozenset[TargetKind]:
        return self.actuator.takes

    @property
    def params(self) -> Mapping[str, float]:
        return self.actuator.params

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        self.actuator.configure(actuator, joint)

    def law(self, drive: Drive) -> Law:
        # The inner law sees late targets, but the present state: only commands are delayed.
        inner = self.actuator.law(drive)
        # Kept: it is drawn by `draw` at each reset, which a clear would undo.
        lag_E = drive.buffer("lag_E", dtype=torch.int64, keep=True)
        # Only the targets that the inner actuator takes are stored.
        fields = [f"{kind}_EN" for kind in sorted(self.takes)]
        # One more than the longest lag, since a lag of 0 takes the newest.
        ring = SubstepRing(drive, "targets", self.max_lag + 1, len(fields) * drive.num_joints)

        def draw(mask_E: Bool[Tensor, " E"]) -> None:
            # Drawn for all rows, since shapes must not depend on the mask.
            drawn_E = drive.integers(1, self.min_lag, self.max_lag)[:, 0]
            lag_E.copy_(torch.where(mask_E, drawn_E, lag_E))

        def late_EN(state: JointState, target: JointTarget) -> Tensor:
            # Push first: with lag 0 this substep's target arrives now.
            ring.push(torch.cat([getattr(target, field) for field in fields], dim=1))
            arrived = ring.at_rows(lag_E).chunk(len(fields), dim=1)
            # Targets that it does not take pass through unchanged.
            return inner(state, target._replace(**dict(zip(fields, arrived, strict=True))))

        # Entries of a group draw the same numbers.
        if self.lag_group:
            drive.on_reset(draw, stream=f"actuators/lag of {self.lag_group}")
        else:
            drive.on_reset(draw)
        return late_EN
