"""These terms observe, rate and end episodes in which a robot follows a motion with its whole body.

Kernels and limits are as in mjlab's tracking task (its src/mjlab/tasks/tracking, commit 0eda4e7), which has them
from BeyondMimic (Liao et al., 2025): errors are means over bodies, and of their squares.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Positive
from ksim_rl.envs.term import MetricTerm, ObservationTerm, TerminationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.actions import JointAction
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import GaussianReward, OfJoints
from ksim_rl.mdp.motion_tracking import OfMotion, OfMotionBodies
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.motion_clock import (
    motion_bodies,
    motion_clip,
    motion_joints,
    motion_time,
)
from ksim_rl.tracking.reference import OfAlignedBodies, OfAnchor, motion_velocities


def first_axes(quat_EN4: Float[Tensor, "E N 4"]) -> Float[Tensor, "E L"]:
    """Return the x, then the y axis of orientations, which describe a rotation without jumps; flat."""
    axes_1123 = constant((1.0, 0.0, 0.0, 0.0, 1.0, 0.0), quat_EN4.device).view(1, 1, 2, 3)
    # [E, N, 1, 4] on [1, 1, 2, 3]: both axes of each body.
    return quaternion.rotate(quat_EN4[:, :, None], axes_1123).flatten(start_dim=1)


# -- observations ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class MotionAnchorPos(OfAnchor, ObservationTerm):
    """Where the motion's anchor is, seen from the robot's, in its frame, m, [E, 3]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        own = view.body(self.anchor)
        pos_E3, _ = self.wanted(view)
        # Relative to the robot, so that the policy needs no place in the world.
        return quaternion.rotate_inverse(own.quat_EL, pos_E3 - own.pos_EL)


@dataclass(frozen=True, kw_only=True)
class MotionAnchorAxes(OfAnchor, ObservationTerm):
    """The x and y axes of the motion's anchor in the frame of the robot's, [E, 6]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        own = view.body(self.anchor)
        _, quat_E4 = self.wanted(view)
        # The rotation from the robot's anchor to the motion's.
        turn_E4 = quaternion.multiply(quaternion.conjugate(own.quat_EL), quat_E4)
        return first_axes(turn_E4[:, None])


@dataclass(frozen=True, kw_only=True)
class BodiesFromAnchor(ObservationTerm):
    """Where the robot's bodies are, or their x and y axes, in the frame of a body, m, [E, 3N] or [E, 6N]."""

    anchor: str
    bodies: Patterns
    part: Literal["positions", "axes"] = "positions"

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        anchor = view.body(self.anchor)
        bodies = view.bodies(self.bodies)
        turn_EN4 = anchor.quat_EL[:, None]
        if self.part == "positions":
            away_EN3 = bodies.pos_EN3 - anchor.pos_EL[:, None]
            return quaternion.rotate_inverse(turn_EN4, away_EN3).flatten(start_dim=1)
        turned_EN4 = quaternion.multiply(quaternion.conjugate(turn_EN4), bodies.quat_EN4)
        return first_axes(turned_EN4)


# -- actions ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class JointPositionAroundMotion(OfMotion, JointAction):
    """Positions (rad or m): the shaped action, relative to where the motion has the joints at the end of the env step.

    The offset that `RandomizeDefaultJointPos` adds to the default pose is added here too: it stands for joints that
    read wrongly.
    """

    def __call__(self, view: EnvView, action_EK: Float[Tensor, "E K"]) -> None:
        joints = view.joints(self.joints)
        # At the end of the step, when the target should be reached.
        time_E = motion_time(view, self.file) + view.step_dt
        clip_E = motion_clip(view, self.file)
        pos_EK, _ = view.motion(self.file).sample_joints(time_E, joints.index, clip_E)
        # The error that this world's joints read with.
        wrong_EK = joints.default_pos_EL - view.default_qpos_L[joints.qpos]
        view.write_joint_pos_target(self.joints, pos_EK + wrong_EK + self.shaped(view, action_EK))


# -- rewards ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TrackAnchorPos(OfAnchor, GaussianReward):
    """exp(-|p - pref|^2 / std^2) of the anchor, world frame, m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        pos_E3, _ = self.wanted(view)
        error_E3 = view.body(self.anchor).pos_EL - pos_E3
        return self.rate(error_E3.square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TrackAnchorQuat(OfAnchor, GaussianReward):
    """exp(-a^2 / std^2), `a` the angle of the anchor from its orientation in the motion, rad, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        _, quat_E4 = self.wanted(view)
        angle_E = quaternion.angle_between(view.body(self.anchor).quat_EL, quat_E4)
        return self.rate(angle_E.square())


@dataclass(frozen=True, kw_only=True)
class TrackAlignedPos(OfAlignedBodies, GaussianReward):
    """exp(-mean_b |p_b - pref_b|^2 / std^2) of bodies and the aligned motion, m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        away_EN3 = view.bodies(self.bodies).pos_EN3 - self.aligned(view).pos_EN3
        return self.rate(away_EN3.square().sum(-1).mean(-1))


@dataclass(frozen=True, kw_only=True)
class TrackAlignedQuat(OfAlignedBodies, GaussianReward):
    """exp(-mean_b a_b^2 / std^2), `a` the angles of bodies from the aligned motion, rad, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        own_EN4 = view.bodies(self.bodies).quat_EN4
        angle_EN = quaternion.angle_between(own_EN4, self.aligned(view).quat_EN4)
        return self.rate(angle_EN.square().mean(-1))


@dataclass(frozen=True, kw_only=True)
class TrackBodyLinVel(OfMotionBodies, GaussianReward):
    """exp(-mean_b |v_b - vref_b|^2 / std^2), world frame, m/s, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        lin_vel_EN3, _ = motion_velocities(view, self.file, self.bodies)
        error_EN3 = view.bodies(self.bodies).lin_vel_EN3 - lin_vel_EN3
        return self.rate(error_EN3.square().sum(-1).mean(-1))


@dataclass(frozen=True, kw_only=True)
class TrackBodyAngVel(OfMotionBodies, GaussianReward):
    """exp(-mean_b |w_b - wref_b|^2 / std^2), world frame, rad/s, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        _, ang_vel_EN3 = motion_velocities(view, self.file, self.bodies)
        error_EN3 = view.bodies(self.bodies).ang_vel_EN3 - ang_vel_EN3
        return self.rate(error_EN3.square().sum(-1).mean(-1))


# -- terminations ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class OffHeight(OfMotionBodies, TerminationTerm):
    """A body is more than `distance` (m) higher or lower than in the motion; position stage."""

    distance: Positive

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        # Only z of the offset: drift along the ground is no failure.
        return (self.offset(view)[..., 2].abs() > self.distance).any(-1)


@dataclass(frozen=True, kw_only=True)
class OffUpright(OfAnchor, TerminationTerm):
    """The anchor is tilted otherwise than in the motion: the vertical parts of its z axes differ by more than `limit`.

    1 - cos(a) of the angle `a` to the vertical, where the motion is upright: 0.8 is 78 degrees.
    """

    limit: Positive

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        _, quat_E4 = self.wanted(view)
        own_E = _upward(view.body(self.anchor).quat_EL)
        return (own_E - _upward(quat_E4)).abs() > self.limit


def _upward(quat_E4: Tensor) -> Tensor:
    # z of the body's z axis: the third diagonal entry of the rotation matrix.
    return 1.0 - 2.0 * quat_E4[:, 1:3].square().sum(-1)


# -- metrics ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class BodyPosError(OfAlignedBodies, MetricTerm):
    """Mean distance of bodies from the aligned motion, m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        away_EN3 = view.bodies(self.bodies).pos_EN3 - self.aligned(view).pos_EN3
        return torch.linalg.vector_norm(away_EN3, dim=-1).mean(-1)


@dataclass(frozen=True, kw_only=True)
class BodyDrift(OfMotionBodies, MetricTerm):
    """Mean distance of bodies from where they are in the motion, world frame, m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        pos_EN3, _ = motion_bodies(view, self.file, self.bodies)
        away_EN3 = view.bodies(self.bodies).pos_EN3 - pos_EN3
        return torch.linalg.vector_norm(away_EN3, dim=-1).mean(-1)


@dataclass(frozen=True, kw_only=True)
class MotionJointError(OfMotion, OfJoints, MetricTerm):
    """Mean absolute difference of joint positions from the motion's, rad or m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        pos_EL, _ = motion_joints(view, self.file, self.joints)
        return (view.joints(self.joints).pos_EL - pos_EL).abs().mean(-1)
