"""These rewards rate how a robot holds itself and moves: its tilt, its height, its joints, velocities of its bodies."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant, values_by_name
from ksim_rl.mdp.fields import GaussianReward, OfEntity, OfJoints
from ksim_rl.mdp.quantities import commanded_speed, is_commanded, root_height
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class OfTilt(OfEntity):
    """A reward of the tilt of a body.

    Attributes:
        body: its name; None is the root of `entity`.
    """

    body: str | None = None

    def tilt(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return |g_xy|^2, `g` the direction of gravity in the body's frame: the squared sine of the tilt."""
        if self.body is None:
            return view.entity(self.entity).projected_gravity_EL[:, :2].square().sum(-1)
        # The world's z axis in the body's frame: the z components of the body's x and y axes.
        return view.body(self.body).axes_E33[:, :2, 2].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class Upright(OfTilt, GaussianReward):
    """exp(-|g_xy|^2 / std^2), `g` the direction of gravity in the body's frame; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.tilt(view))


@dataclass(frozen=True, kw_only=True)
class TiltL2(OfTilt, RewardTerm):
    """|g_xy|^2, `g` the direction of gravity in the body's frame, the squared sine of the tilt; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.tilt(view)


@dataclass(frozen=True, kw_only=True)
class RootHeightL2(OfEntity, RewardTerm):
    """(h - target_height)^2, `h` the height of the root body's frame above the ground, m^2, [E]; position stage.

    Attributes:
        target_height: m.
    """

    target_height: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (root_height(view, self.entity) - self.target_height).square()


@dataclass(frozen=True, kw_only=True)
class Pose(OfJoints, RewardTerm):
    """exp(-mean_j((q_j - q0_j)^2 / std_j^2)) about the default pose, [E]; position stage.

    How far a joint may stray depends on the commanded speed s = |c_xy| + |c_z|: standing below `walking_threshold`,
    running from `running_threshold` on, walking between.

    Attributes:
        std_standing, std_walking, std_running: rad or m by joint; keys are regular expressions, and together they
            match each of `joints` once.
    """

    command: str
    std_standing: Mapping[str, Positive]
    std_walking: Mapping[str, Positive]
    std_running: Mapping[str, Positive]
    walking_threshold: float
    running_threshold: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_in_range("running_threshold", self.running_threshold, low=self.walking_threshold)

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        speed_E1 = commanded_speed(view, self.command).unsqueeze(-1)
        std_EL = torch.where(
            speed_E1 < self.walking_threshold,
            self._std(view, "std_standing"),
            torch.where(
                speed_E1 < self.running_threshold,
                self._std(view, "std_walking"),
                self._std(view, "std_running"),
            ),
        )
        error_EL = view.joints(self.joints).pos_rel_EL
        return torch.exp(-(error_EL / std_EL).square().mean(-1))

    def _std(self, view: EnvView, field: str) -> Tensor:
        names = view.joints(self.joints).names
        return constant(values_by_name(field, getattr(self, field), names), view.device)


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
