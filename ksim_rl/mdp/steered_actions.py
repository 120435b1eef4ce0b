"""These actions move the position targets of joints by a velocity or an acceleration, or bound how fast they move."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.actions import JointAction, JointPositionAction


class _Target(NamedTuple):
    """Position targets, rad or m, and their velocities, per second."""

    pos_EK: Float[Tensor, "E K"]
    vel_EK: Float[Tensor, "E K"]


@dataclass(frozen=True, kw_only=True)
class SteeredAction(JointAction):
    """An action that moves position targets from where they are; an episode starts where the joints are, at rest.

    Targets stay inside the soft limits of their joints: one that ran on beyond a limit would take as long to come back.
    """

    def held(self, view: EnvView) -> _Target:
        """Return the targets at the end of the last env step."""
        pos_EK = view.buffer("pos_EK", self.num_targets(view))
        vel_EK = view.buffer("vel_EK", self.num_targets(view))
        has_begun_E = view.buffer("has_begun_E")
        # A reset has zeroed the buffers; zero is no target.
        now_EK = torch.where(has_begun_E[:, None] > 0, pos_EK, view.joints(self.joints).pos_EL)
        has_begun_E.fill_(1.0)
        return _Target(now_EK, vel_EK)

    def num_targets(self, view: EnvView) -> int:
        """Return how many joints are steered."""
        return len(view.joints(self.joints))

    def steer(self, view: EnvView, held: _Target, vel_EK: Float[Tensor, "E K"]) -> None:
        """Move targets for an env step at a velocity, rad/s or m/s, and write them."""
        low_K, high_K = view.joints(self.joints).soft_limits_L2.unbind(-1)
        free_EK = held.pos_EK + vel_EK * view.step_dt
        pos_EK = torch.clamp(free_EK, low_K, high_K)
        view.buffer("pos_EK", pos_EK.shape[1]).copy_(pos_EK)
        # A target at its limit stands.
        view.buffer("vel_EK", pos_EK.shape[1]).copy_(torch.where(pos_EK == free_EK, vel_EK, 0.0))
        view.write_joint_pos_target(self.joints, pos_EK)


@dataclass(frozen=True, kw_only=True)
class IntegratedVelocityAction(SteeredAction):
    """Positions whose velocity (rad/s or m/s) is the shaped action: q + v dt in each env step, inside the soft limits.

    An episode starts where the joints are.
    """

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        self.steer(view, self.held(view), self.shaped(view, action_EK))


@dataclass(frozen=True, kw_only=True)
class IntegratedAccelerationAction(SteeredAction):
    """Positions whose acceleration (rad/s^2 or m/s^2) is the shaped action: v + a dt, then q + v dt, in each env step.

    The velocity stays within `max_velocity` (rad/s or m/s), positions inside the soft limits. An episode starts where
    the joints are, at rest.
    """

    max_velocity: Positive = 10.0

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        held = self.held(view)
        free_EK = held.vel_EK + self.shaped(view, action_EK) * view.step_dt
        self.steer(view, held, free_EK.clamp(-self.max_velocity, self.max_velocity))


@dataclass(frozen=True, kw_only=True)
class BoundedAccelerationAction(SteeredAction, JointPositionAction):
    """Positions as `JointPositionAction` has them, to which targets move within `max_acceleration`, rad/s^2 or m/s^2.

    The velocity that would reach the asked position within the env step differs from the last one by
    `max_acceleration` dt at most, and targets stay inside the soft limits. An episode starts where the joints are.
    """

    max_acceleration: Positive

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        held = self.held(view)
        wanted_EK = (self.target(view, action_EK) - held.pos_EK) / view.step_dt
        most = self.max_acceleration * view.step_dt
        self.steer(view, held, held.vel_EK + (wanted_EK - held.vel_EK).clamp(-most, most))
