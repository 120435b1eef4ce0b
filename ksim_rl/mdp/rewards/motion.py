"""These rewards rate how bodies move; weights are usually negative. Velocities are of the current state."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.commands.speed import is_commanded
from ksim_rl.mdp.fields import OfEntity, OfJoints
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class LinVelZL2(OfEntity, RewardTerm):
    """v_z^2, `v` the root's linear velocity in its own frame, (m/s)^2, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.entity(self.entity).root_lin_vel_b_EL[:, 2].square()


@dataclass(frozen=True, kw_only=True)
class AngVelXYL2(OfEntity, RewardTerm):
    """|w_xy|^2, `w` the root's angular velocity in its own frame, (rad/s)^2, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.entity(self.entity).root_ang_vel_b_EL[:, :2].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class BodyAngularVelocity(RewardTerm):
    """|w_xy|^2, `w` a body's angular velocity in the world frame, (rad/s)^2, [E]; velocity stage. Yaw is free."""

    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.body(self.body).ang_vel_EL[:, :2].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class AngularMomentum(RewardTerm):
    """|L|^2 of a `subtreeangmom` sensor, about the subtree's centre of mass, (kg m^2/s)^2, [E]; velocity stage."""

    sensor: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.sensor(self.sensor).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class LinkAccelerationL2(RewardTerm):
    """Sum over bodies of |(v_t - v_{t-1}) / step_dt|^2, (m/s^2)^2, [E]: the mean acceleration over the env step.

    `v` is the velocity of the body frame's origin in the world (velocity stage). An impact shows in full, whichever
    substep it falls on, and so does a push that sets velocities. 0 in the first step of an episode.
    """

    bodies: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        vel_EN3 = view.bodies(self.bodies).lin_vel_EN3
        last_EN3 = view.buffer("last_vel_EN3", *vel_EN3.shape[1:])
        acceleration_EN3 = (vel_EN3 - last_EN3) / view.step_dt
        last_EN3.copy_(vel_EN3)
        return torch.where(view.episode_step_E <= 1, 0.0, acceleration_EN3.square().sum((-2, -1)))


@dataclass(frozen=True, kw_only=True)
class MotionlessAtRest(OfJoints, RewardTerm):
    """Sum of squared joint velocities while the command asks to stand, else 0, (rad/s)^2 or (m/s)^2, [E].

    Attributes:
        command, command_threshold: standing means that the commanded speed does not exceed the threshold.
    """

    command: str
    command_threshold: NonNegative

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        motion_E = view.joints(self.joints).vel_EL.square().sum(-1)
        return motion_E * (1.0 - is_commanded(view, self.command, self.command_threshold))
