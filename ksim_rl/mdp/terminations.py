"""Terminations are the conditions that end an episode."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive, Within
from ksim_rl.envs.term import TerminationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import (
    OfContacts,
    OfEntity,
    OfJoints,
    distance_from_origin,
    root_height,
)


@dataclass(frozen=True, kw_only=True)
class TimeOut(TerminationTerm):
    """The episode has lasted `episode_length_s`: a truncation, not a failure."""

    time_out: bool = True

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        # `time_out_offset_E` staggers the first episodes, so that not all envs reset in the same step.
        return view.episode_step_E + view.time_out_offset_E >= view.max_episode_length


@dataclass(frozen=True, kw_only=True)
class BadOrientation(OfEntity, TerminationTerm):
    """The root is tilted further than a limit, rad, the angle between its z axis and the world's; position stage."""

    limit_angle: Annotated[float, Within(low=0.0, high=math.pi, low_open=True)]

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        # The cosine falls as the angle grows, so comparing cosines needs no acos, which is ill-conditioned at 0.
        return -view.entity(self.entity).projected_gravity_EL[:, 2] < math.cos(self.limit_angle)


@dataclass(frozen=True, kw_only=True)
class RootHeightBelow(OfEntity, TerminationTerm):
    """The root body's frame is closer than `minimum_height` (m) to the ground below it; position stage."""

    minimum_height: float

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        # Above the ground below, so that a robot on stairs does not count as fallen.
        return root_height(view, self.entity) < self.minimum_height


@dataclass(frozen=True, kw_only=True)
class FarFromOrigin(OfEntity, TerminationTerm):
    """The root is further than `distance` (m) from where its env starts, in the horizontal plane; position stage."""

    distance: Positive

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        return distance_from_origin(view, self.entity) > self.distance


@dataclass(frozen=True, kw_only=True)
class OutsideTerrain(OfEntity, TerminationTerm):
    """The root is beyond the edge of its env's ground, if it has one, or closer to it than a margin (m): a truncation.

    Robots whose feet must not step over the edge need a margin of about their own reach.
    """

    time_out: bool = True
    margin: NonNegative = 0.5

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        # The ground is a square about the world's origin; the coordinate further out decides.
        reach_E = view.entity(self.entity).root_pos_EL[:, :2].abs().amax(-1)
        return reach_E > view.terrain.half_width - self.margin


@dataclass(frozen=True, kw_only=True)
class RootVelocityAbove(OfEntity, TerminationTerm):
    """The root body moves (m/s) or turns (rad/s) faster than a robot can: physics has gone wrong; velocity stage."""

    linear: Positive | None = None
    angular: Positive | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.linear is None and self.angular is None:
            raise ValueError("linear=None, angular=None: give at least one limit")

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        root = view.entity(self.entity)
        ends_E = torch.zeros(view.num_envs, dtype=torch.bool, device=view.device)
        # Both limits are optional; either one ends the episode.
        if self.linear is not None:
            # A NaN compares as False here; the env itself ends worlds whose state is not finite.
            ends_E = ends_E | (
                torch.linalg.vector_norm(root.root_lin_vel_w_EL, dim=-1) > self.linear
            )
        if self.angular is not None:
            ends_E = ends_E | (
                torch.linalg.vector_norm(root.root_ang_vel_b_EL, dim=-1) > self.angular
            )
        return ends_E


@dataclass(frozen=True, kw_only=True)
class JointVelocityAbove(OfJoints, TerminationTerm):
    """A joint moves faster than `limit` (rad/s or m/s); velocity stage."""

    limit: Positive

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        return (view.joints(self.joints).vel_EL.abs() > self.limit).any(-1)


@dataclass(frozen=True, kw_only=True)
class JointLimitViolated(OfJoints, TerminationTerm):
    """A joint is outside of its soft limits by more than `margin` (rad or m); position stage."""

    margin: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        joints = view.joints(self.joints)
        pos_EN = joints.pos_EL
        limits_N2 = joints.soft_limits_L2
        # Positive outside; unlimited joints have infinite limits, and are never beyond them.
        beyond_EN = torch.maximum(limits_N2[:, 0] - pos_EN, pos_EN - limits_N2[:, 1])
        return (beyond_EN > self.margin).any(-1)


@dataclass(frozen=True, kw_only=True)
class IllegalContact(OfContacts, TerminationTerm):
    """Something touches that should not: its sensor sees more than `threshold`; acceleration stage.

    A sensor with `every_substep` has seen each substep of the env step, others the last one.
    """

    threshold: NonNegative = 0.0

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        force_ESN = torch.linalg.vector_norm(view.contact(self.sensor).force_history_ESN3, dim=-1)
        # One element in one substep is enough.
        return (force_ESN > self.threshold).flatten(1).any(-1)


@dataclass(frozen=True, kw_only=True)
class NonFiniteState(TerminationTerm):
    """A joint acceleration, an actuator's force or a sensor's reading is not finite; acceleration stage.

    A world whose positions or velocities are not finite ends without this term, as `non_finite`; this one also catches
    faults that have not reached them, such as a sensor that divides by zero.
    """

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        world = view.world
        # One test for all three, so that it takes few kernels.
        parts = (world.qacc_EL, world.actuator_force_EL, world.sensordata_EL)
        return ~torch.isfinite(torch.cat(parts, dim=-1)).all(-1)
