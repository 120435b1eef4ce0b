"""These metrics say how well and how smoothly commands are followed, the cost of moving, and who succeeds.

Poses and velocities are of the current state, contacts and forces of the last physics substep (acceleration stage).
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Filled, Positive
from ksim_rl.checks import check_known
from ksim_rl.envs.term import MetricTerm, Reduction
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.pose import OfTarget
from ksim_rl.mdp.fields import (
    OfCommand,
    OfEntity,
    OfFeet,
    OfJoints,
    OfSensor,
    OfSites,
    contact_force,
    mechanical_power,
)
from ksim_rl.mdp.rewards.joints import change


@dataclass(frozen=True, kw_only=True)
class LinearVelocityError(OfCommand, OfEntity, MetricTerm):
    """|c_xy - v_xy| of a command (vx, vy, wz) and the root velocity, both in the root's frame, m/s; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # Columns x and y of both, in the root's frame.
        wanted_E2 = view.command(self.command)[:, :2]
        actual_E2 = view.entity(self.entity).root_lin_vel_b_EL[:, :2]
        return torch.linalg.vector_norm(wanted_E2 - actual_E2, dim=-1)


@dataclass(frozen=True, kw_only=True)
class AngularVelocityError(OfCommand, OfEntity, MetricTerm):
    """|c_z - w_z| of a command (vx, vy, wz) and the root velocity, both in the root's frame, rad/s; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (
            view.command(self.command)[:, 2] - view.entity(self.entity).root_ang_vel_b_EL[:, 2]
        ).abs()


@dataclass(frozen=True, kw_only=True)
class ActionAcceleration(MetricTerm):
    """Mean over columns of |a_t - 2 a_{t-1} + a_{t-2}|; actions before an episode are 0."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # The change of the change of the action: two buffers back, one of them the env's own.
        return change(view, "last_rate_EL", view.action_EL - view.last_action_EL).abs().mean(-1)


@dataclass(frozen=True, kw_only=True)
class FootSlipSpeed(OfFeet, MetricTerm):
    """Mean over the feet in contact of their horizontal speed at that moment, world frame, m/s; 0 without one."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        found_EF = self.contact(view).found_EN
        velocity_EF2 = view.sites(self.sites).lin_vel_of_contacts_EN3[..., :2]
        speed_EF = torch.linalg.vector_norm(velocity_EF2, dim=-1)
        # The clamp makes a flight without any contact read 0, not NaN.
        return (speed_EF * found_EF).sum(-1) / found_EF.sum(-1).clamp(min=1.0)


@dataclass(frozen=True, kw_only=True)
class PeakFootHeight(OfSites, MetricTerm):
    """Height of the highest foot above the ground below it, m, [E]; by default its greatest value in the episode."""

    reduce: Reduction = "max"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.sites(self.sites).height_EN.amax(-1)


@dataclass(frozen=True, kw_only=True)
class PeakContactForce(OfSensor, MetricTerm):
    """Greatest net contact force, N, [E], sampled at each env step's last substep; by default its peak so far."""

    reduce: Reduction = "max"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return contact_force(view, self.sensor).amax(-1)


@dataclass(frozen=True, kw_only=True)
class Power(OfJoints, MetricTerm):
    """sum_j |effort_j * velocity_j|, W, [E]: mechanical power of the actuators; braking costs as much as driving."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return mechanical_power(view, self.joints)


@dataclass(frozen=True, kw_only=True)
class CostOfTransport(OfJoints, OfEntity, MetricTerm):
    """Energy / (weight * distance) since the start of the episode, no unit; it needs gravity.

    Energy is the integral of `Power`; distance is the length of the root's path over the ground; the weight is of
    the nominal model (m g of the root body with all that hangs on it). A path counts as `min_distance` (m) at least, so
    that standing still gives a finite value.
    """

    reduce: Reduction = "last"
    min_distance: Positive = 0.1

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        robot = view.entity(self.entity)
        model = view.world.mj_model
        # From the model on the host: randomized masses do not count, so that envs can be compared.
        weight = float(model.body_subtreemass[robot.root.id] * np.linalg.norm(model.opt.gravity))
        if weight == 0.0:
            raise ValueError(
                "CostOfTransport without gravity: a weight of 0 N has no cost of transport"
            )
        # Buffers start at zero in each episode, so that these are sums over it.
        energy_E = view.buffer("energy_E")
        distance_E = view.buffer("distance_E")
        energy_E.add_(mechanical_power(view, self.joints) * view.step_dt)
        # Horizontal path, summed up: a robot that walks in a circle has moved too.
        distance_E.add_(
            torch.linalg.vector_norm(robot.root_lin_vel_w_EL[:, :2], dim=-1) * view.step_dt
        )
        return energy_E / (weight * distance_E.clamp(min=self.min_distance))


@dataclass(frozen=True, kw_only=True)
class Success(MetricTerm):
    """1 where the episode ends by one of the named `terminations` of the env and by no other, else 0, [E].

    With the time-out it is the share of episodes that survived. Envs that are not made of terms have `SuccessTracker`.
    """

    reduce: Reduction = "last"
    terminations: Annotated[tuple[str, ...], Filled("name at least one, such as ('time_out',)")]

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        for name in self.terminations:
            check_known("termination", name, view.terminations)
        # `wanted` by name, `others` by exclusion: an episode may end by several terminations in the same
        # step.
        wanted = [flag_E for name, flag_E in view.terminations.items() if name in self.terminations]
        others = [
            flag_E for name, flag_E in view.terminations.items() if name not in self.terminations
        ]
        succeeds_E = torch.stack(wanted).any(0)
        if others:
            succeeds_E = succeeds_E & ~torch.stack(others).any(0)
        return succeeds_E.to(torch.float32)


@dataclass(frozen=True, kw_only=True)
class TargetReached(OfTarget, MetricTerm):
    """1 while a body or site is within `tolerance` (m) of the position that a `CartesianCommand` asks for, else 0.

    Position stage, with the command that the policy saw. `reduce="last"` (the default) asks whether it is there in the
    end, "max" whether it ever was, "mean" for which share of the time.
    """

    reduce: Reduction = "last"
    tolerance: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (self.distance(view) <= self.tolerance).to(torch.float32)
