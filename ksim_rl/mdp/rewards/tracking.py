"""These rewards rate how well a command is followed, and how a robot holds itself and moves."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Positive, Range
from ksim_rl.checks import check_in_range
from ksim_rl.envs.term import RewardTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.actions import per_joint
from ksim_rl.mdp.commands.pose import OfTarget, target_pose_w
from ksim_rl.mdp.fields import (
    GaussianReward,
    InFrame,
    OfCommand,
    OfEntity,
    OfJoints,
    OfSensor,
    SiteAndBody,
    commanded_speed,
    is_commanded,
    root_height,
)
from ksim_rl.mdp.rewards.joints import second_difference
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors.rays import grid_points

Turn = Literal["both", "roll", "pitch"]
_RATE_COLUMNS = {"both": slice(0, 2), "roll": slice(0, 1), "pitch": slice(1, 2)}
# 32 of the 17 x 11 points of the height scan, evenly taken in their order.
_TAKEN = torch.linspace(0, 186, 32).long()
_AROUND = tuple((x, y) for x, y, _ in grid_points((1.6, 1.0), 0.1)[_TAKEN].tolist())
# A turn about x moves the vertical out of y, and the other way round.
_TILT_COLUMNS = {"both": slice(0, 2), "roll": slice(1, 2), "pitch": slice(0, 1)}


def tolerance(
    value: Float[Tensor, "*shape"],
    *,
    low: float = -math.inf,
    high: float = math.inf,
    margin: float,
    value_at_margin: float = 0.1,
    shape: Literal["gaussian", "linear", "quadratic", "long_tail"] = "gaussian",
) -> Float[Tensor, "*shape"]:
    """Return 1 inside [low, high], falling to `value_at_margin` at `margin` outside of it and on towards 0.

    Formula: Tassa et al., "DeepMind Control Suite" (2018), section 4. With d the distance to the interval in margins
    and v the value there, "gaussian" is `v ** (d ** 2)`, "long_tail" `1 / (1 + (1 / v - 1) d ** 2)`, and "linear" and
    "quadratic" are 1 - (1 - v) times d and d ** 2, but not below 0; v may be 0 there. Without a margin it is 0 outside.
    """
    # Distance to the interval, 0 inside; one of the two differences is negative.
    outside = torch.clamp(torch.maximum(low - value, value - high), min=0.0)
    # A margin of 0 would divide by zero.
    if margin == 0.0:
        return (outside == 0.0).to(value.dtype)
    distance = outside / margin
    # A long tail still rises towards the interval far away, where the others are flat or 0.
    if shape == "long_tail":
        return 1.0 / (1.0 + (1.0 / value_at_margin - 1.0) * distance.square())
    if shape != "gaussian":
        if shape == "linear":
            fall = distance
        else:
            fall = distance.square()
        # Falls through `value_at_margin` at one margin, and ends at 0.
        return torch.clamp(1.0 - (1.0 - value_at_margin) * fall, min=0.0)
    # The power v ** (d ** 2) as an exponential, since log(v) is known on the host.
    return torch.exp(distance.square() * math.log(value_at_margin))


@dataclass(frozen=True, kw_only=True)
class TrackLinearVelocity(OfCommand, OfEntity, GaussianReward):
    """exp(-(|c_xy - v_xy|^2 + v_z^2) / std^2), `v` the root's linear velocity in its own frame, m/s, [E]."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        vel_E3 = view.entity(self.entity).root_lin_vel_b_EL
        # Both in the root's frame, x and y.
        error_E2 = view.command(self.command)[:, :2] - vel_E3[:, :2]
        # Hopping is no part of any command, so that all vertical speed is an error.
        return self.rate(error_E2.square().sum(-1) + vel_E3[:, 2].square())


@dataclass(frozen=True, kw_only=True)
class TrackAngularVelocity(OfCommand, OfEntity, GaussianReward):
    """exp(-((c_z - w_z)^2 + |w_xy|^2) / std^2), `w` the root's angular velocity in its own frame, rad/s, [E]."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        vel_E3 = view.entity(self.entity).root_ang_vel_b_EL
        error_E = view.command(self.command)[:, 2] - vel_E3[:, 2]
        # Roll and pitch rates count as errors, too.
        return self.rate(error_E.square() + vel_E3[:, :2].square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TrackRootHeight(OfCommand, OfEntity, GaussianReward):
    """exp(-(c - h)^2 / std^2), `h` the root frame's height above ground, m, [E], `c` such as `BaseHeightCommand`."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        error_E = view.command(self.command)[:, 0] - root_height(view, self.entity)
        return self.rate(error_E.square())


@dataclass(frozen=True, kw_only=True)
class NearBody(SiteAndBody, GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of a site from a body's origin, m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.offset(view).square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TrackPosition(OfTarget, GaussianReward):
    """exp(-d^2 / std^2), `d` the distance of a body or site from the commanded position, m; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.distance(view).square())


@dataclass(frozen=True, kw_only=True)
class TrackOrientation(OfCommand, InFrame, GaussianReward):
    """exp(-a^2 / std^2), `a` the angle, rad, between a body and `command` (`CartesianCommand`), in `frame`."""

    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        command_EK = view.command(self.command)
        # The position of the target plays no part here.
        _, target_E4 = target_pose_w(view, command_EK, frame=self.frame, entity=self.entity)
        if target_E4 is None:
            raise ValueError(
                f"command={self.command!r} has {command_EK.shape[1]} numbers: expected position and quaternion"
            )
        quat_E4 = view.body(self.body).quat_EL
        return self.rate(quaternion.angle_between(quat_E4, target_E4).square())


@dataclass(frozen=True, kw_only=True)
class TrackJointPosition(OfCommand, OfJoints, GaussianReward):
    """exp(-mean_j((c_j - q_j)^2) / std^2), rad or m, [E], `c` such as `JointPositionCommand`; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        error_EL = view.command(self.command) - view.joints(self.joints).pos_EL
        return self.rate(error_EL.square().mean(-1))


@dataclass(frozen=True, kw_only=True)
class OfTilt(OfEntity):
    """A reward of the tilt of a body, or of its roll or pitch alone; None is the root of `entity`."""

    body: str | None = None
    about: Turn = "both"

    def tilt(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return |g_xy|^2, `g` the direction of gravity in the body's frame: the squared sine of the tilt.

        Of a roll alone it is g_y^2, of a pitch g_x^2.
        """
        columns = _TILT_COLUMNS[self.about]
        if self.body is None:
            return view.entity(self.entity).projected_gravity_EL[:, columns].square().sum(-1)
        # The world's z axis in the body's frame: the z components of the body's x and y axes.
        return view.body(self.body).axes_E33[:, columns, 2].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class Upright(OfTilt, GaussianReward):
    """exp(-|g_xy|^2 / std^2), `g` the direction of gravity in the body's frame; position stage.

    With `along="ground"`, `g` is against the normal of the ground instead: of the plane through 32 points of a grid of
    1.6 x 1.0 m about the root, which turns with its yaw, as mjlab's velocity tasks on rough ground have it. Where these
    points lie on no plane, it is gravity.
    """

    along: Literal["vertical", "ground"] = "vertical"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        if self.along == "vertical":
            return self.rate(self.tilt(view))
        entity = view.entity(self.entity)
        normal_E3 = entity.ground_scan(_AROUND).normal_E3
        if self.body is None:
            axes_E33 = entity.root.axes_E33
        else:
            axes_E33 = view.body(self.body).axes_E33
        # The normal's components along the body's x and y axes.
        tilt_E2 = (axes_E33[:, _TILT_COLUMNS[self.about]] * normal_E3[:, None]).sum(-1)
        return self.rate(tilt_E2.square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TiltL2(OfTilt, RewardTerm):
    """|g_xy|^2, `g` the direction of gravity in the body's frame, the squared sine of the tilt; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.tilt(view)


@dataclass(frozen=True, kw_only=True)
class RootHeightL2(OfEntity, RewardTerm):
    """(h - target_height)^2, `h` the height of the root body's frame above the ground, m^2, [E]; position stage."""

    target_height: float

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return (root_height(view, self.entity) - self.target_height).square()


@dataclass(frozen=True, kw_only=True)
class RootHeightInside(OfEntity, RewardTerm):
    """1 while the root frame's height above the ground is inside `height`, m, [E]; outside it falls linearly.

    It is 0 from `margin` (m) outside on; position stage.
    """

    height: Range
    margin: Positive

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        low, high = self.height
        height_E = root_height(view, self.entity)
        return tolerance(
            height_E, low=low, high=high, margin=self.margin, value_at_margin=0.0, shape="linear"
        )


@dataclass(frozen=True, kw_only=True)
class Pose(OfCommand, OfJoints, RewardTerm):
    """exp(-mean_j((q_j - q0_j)^2 / std_j^2)) about the default pose, [E]; position stage.

    How far a joint may stray depends on the commanded speed s = |c_xy| + |c_z|: standing below `walking_threshold`,
    running from `running_threshold` on, walking between. The keys of each table, rad or m, are regular expressions
    that match each of `joints` once.
    """

    std_standing: Mapping[str, Positive]
    std_walking: Mapping[str, Positive]
    std_running: Mapping[str, Positive]
    walking_threshold: float
    running_threshold: float

    def _check_fields(self) -> None:
        super()._check_fields()
        check_in_range("running_threshold", self.running_threshold, low=self.walking_threshold)

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        # [E, 1], to broadcast over joints.
        speed_E1 = commanded_speed(view, self.command).unsqueeze(-1)
        standing_L = per_joint(view, "std_standing", self.std_standing, self.joints)
        walking_L = per_joint(view, "std_walking", self.std_walking, self.joints)
        running_L = per_joint(view, "std_running", self.std_running, self.joints)
        # From the outside in: running or walking first, then standing, which wins below its threshold.
        moving_EL = torch.where(speed_E1 < self.running_threshold, walking_L, running_L)
        std_EL = torch.where(speed_E1 < self.walking_threshold, standing_L, moving_EL)
        error_EL = view.joints(self.joints).pos_rel_EL / std_EL
        return torch.exp(-error_EL.square().mean(-1))


@dataclass(frozen=True, kw_only=True)
class LinVelZL2(OfEntity, RewardTerm):
    """v_z^2, `v` the root's linear velocity in its own frame, (m/s)^2, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.entity(self.entity).root_lin_vel_b_EL[:, 2].square()


@dataclass(frozen=True, kw_only=True)
class AngVelXYL2(OfEntity, RewardTerm):
    """|w_xy|^2, `w` the root's angular velocity in its own frame, (rad/s)^2, [E]; velocity stage.

    `about` takes the rate of roll, w_x^2, or of pitch, w_y^2, alone.
    """

    about: Turn = "both"

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        columns = _RATE_COLUMNS[self.about]
        return view.entity(self.entity).root_ang_vel_b_EL[:, columns].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class BodyAngularVelocity(RewardTerm):
    """|w_xy|^2, `w` a body's angular velocity in the world frame, (rad/s)^2, [E]; velocity stage. Yaw is free."""

    body: str

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return view.body(self.body).ang_vel_EL[:, :2].square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class AngularMomentum(OfSensor, RewardTerm):
    """|L|^2 of a `subtreeangmom` sensor, about the subtree's centre of mass, (kg m^2/s)^2, [E]; velocity stage."""

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
        # Over an env step, not a substep: an impact between the two moments is seen in full.
        acceleration_EN3 = (vel_EN3 - last_EN3) / view.step_dt
        last_EN3.copy_(vel_EN3)
        squares_E = acceleration_EN3.square().sum((-2, -1))
        # The first step has no velocity before it: the buffer's zero is not one.
        return torch.where(view.episode_step_E <= 1, 0.0, squares_E)


@dataclass(frozen=True, kw_only=True)
class LinkJerkL2(RewardTerm):
    """Sum over bodies of |j|^2, (m/s^3)^2, [E], `j` the change of `LinkAccelerationL2`'s acceleration per env step.

    Velocity stage. 0 in the first two steps of an episode.
    """

    bodies: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        vel_EL = view.bodies(self.bodies).lin_vel_EN3.flatten(start_dim=1)
        return second_difference(view, vel_EL).square().sum(-1)


@dataclass(frozen=True, kw_only=True)
class MotionlessAtRest(OfCommand, OfJoints, RewardTerm):
    """Sum of squared joint velocities, (rad/s)^2 or (m/s)^2, while no commanded speed exceeds a threshold, else 0."""

    command_threshold: NonNegative

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        motion_E = view.joints(self.joints).vel_EL.square().sum(-1)
        return motion_E * (1.0 - is_commanded(view, self.command, self.command_threshold))
