"""These terms begin, read, rate and end episodes that follow a reference motion.

`file` is a motion that `view.motion` reads. Kernels are from Peng et al., "DeepMimic" (2018), with scales k written as
std = 1 / sqrt(k): joint positions 2, joint velocities 0.1, ends of limbs 40, root or centre of mass 10.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Positive, Within
from ksim_rl.envs.term import EventTerm, ObservationTerm, Term, TerminationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.fields import GaussianReward, OfJoints
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.motion_clock import (
    motion_bodies,
    motion_joints,
    motion_shift,
    motion_start_time,
    motion_time,
)


@dataclass(frozen=True, kw_only=True)
class OfMotion(Term):
    """A term of a reference motion."""

    file: str


@dataclass(frozen=True, kw_only=True)
class OfMotionBodies(OfMotion):
    """A term of bodies in a reference motion."""

    bodies: Patterns

    def offset(self, view: EnvView) -> Float[Tensor, "E N 3"]:
        """Return the motion's positions of the bodies minus their own, world frame, m; position stage."""
        pos_EN3, _ = motion_bodies(view, self.file, self.bodies)
        # The motion's bodies are shifted to the env's origin by `motion_bodies`.
        return pos_EN3 - view.bodies(self.bodies).pos_EN3


@dataclass(frozen=True, kw_only=True)
class MotionPhase(OfMotion, ObservationTerm):
    """Sine and cosine of 2 pi t / cycle, `t` the time in the motion, [E, 2]; a cycle of None is the whole motion."""

    cycle_s: Positive | None = None

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        # A whole motion as the cycle: its phase tells where in it the env is.
        cycle_s = self.cycle_s or view.motion(self.file).duration_s
        angle_E = motion_time(view, self.file) * (2.0 * math.pi / cycle_s)
        return torch.stack((torch.sin(angle_E), torch.cos(angle_E)), dim=-1)


@dataclass(frozen=True, kw_only=True)
class MotionJoints(OfMotion, OfJoints, ObservationTerm):
    """Positions (rad or m), then velocities (per s), that joints have in the motion `ahead_s` from now, [E, 2L]."""

    ahead_s: float = 0.0

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        if self.ahead_s == 0.0:
            # The present frame is sampled once per step for all terms.
            return torch.cat(motion_joints(view, self.file, self.joints), dim=-1)
        time_E = motion_time(view, self.file) + self.ahead_s
        motion = view.motion(self.file)
        # Positions, then velocities, both of the later moment.
        return torch.cat(motion.sample_joints(time_E, view.joints(self.joints).index), dim=-1)


@dataclass(frozen=True, kw_only=True)
class MotionBodyOffset(OfMotionBodies, ObservationTerm):
    """Where bodies are in the motion minus where they are, world frame, m, [E, 3N]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        return self.offset(view).flatten(start_dim=1)


@dataclass(frozen=True, kw_only=True)
class TrackMotionJointPos(OfMotion, OfJoints, GaussianReward):
    """exp(-sum_j (q_j - qref_j)^2 / std^2), rad or m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        pos_EL, _ = motion_joints(view, self.file, self.joints)
        error_EL = view.joints(self.joints).pos_EL - pos_EL
        return self.rate(error_EL.square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TrackMotionJointVel(OfMotion, OfJoints, GaussianReward):
    """exp(-sum_j (v_j - vref_j)^2 / std^2), rad/s or m/s, [E]; velocity stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        _, vel_EL = motion_joints(view, self.file, self.joints)
        error_EL = view.joints(self.joints).vel_EL - vel_EL
        return self.rate(error_EL.square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class TrackMotionBodyPos(OfMotionBodies, GaussianReward):
    """exp(-sum_b |p_b - pref_b|^2 / std^2), world frame, m, [E]; position stage."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        return self.rate(self.offset(view).square().sum((-2, -1)))


@dataclass(frozen=True, kw_only=True)
class TrackMotionBodyQuat(OfMotionBodies, GaussianReward):
    """exp(-sum_b a_b^2 / std^2), `a` the angle of a body from its orientation in the motion, rad, [E]."""

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        _, quat_EN4 = motion_bodies(view, self.file, self.bodies)
        own_EN4 = view.bodies(self.bodies).quat_EN4
        # The angle is free of the sign of the quaternions.
        angle_EN = quaternion.angle_between(own_EN4, quat_EN4)
        return self.rate(angle_EN.square().sum(-1))


@dataclass(frozen=True, kw_only=True)
class FarFromMotion(OfMotionBodies, TerminationTerm):
    """A body is further than `distance` (m) from where it is in the motion, world frame; position stage."""

    distance: Positive

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        distance_EN = torch.linalg.vector_norm(self.offset(view), dim=-1)
        return (distance_EN > self.distance).any(-1)


@dataclass(frozen=True, kw_only=True)
class MotionFinished(OfMotion, TerminationTerm):
    """The motion's last frame is reached: there is nothing more to follow."""

    time_out: bool = True

    def __call__(self, view: EnvView) -> Bool[Tensor, " E"]:
        # Half a step early: sums of float32 steps may fall short of the end by some rounding.
        return motion_time(view, self.file) > view.motion(self.file).duration_s - 0.5 * view.step_dt


@dataclass(frozen=True, kw_only=True)
class ResetToMotion(OfMotion, EventTerm):
    """Put the whole scene into a state of a reference motion, and remember its time for `motion.motion_time`.

    Episodes begin in `start_range`, shares of its duration. On a terrain all free roots move with the env's origin.
    """

    start_range: Annotated[tuple[float, float], Within(low=0.0, high=1.0, ordered=True)] = (
        0.0,
        1.0,
    )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        motion = view.motion(self.file)
        start_E = motion_start_time(view, self.file)
        # Rows that are not reset keep their start: their clock goes on from it.
        start_E.copy_(torch.where(mask_E, self.draw_share(view) * motion.duration_s, start_E))
        qpos_EL, qvel_EL = motion.sample(start_E)
        # Motions are recorded around the world's origin; on a terrain each env has its own origin.
        view.write_qpos(mask_E, qpos_EL if motion_shift(view) is None else view.at_origins(qpos_EL))
        view.write_qvel(mask_E, qvel_EL)

    def draw_share(self, view: EnvView) -> Float[Tensor, " E"]:
        """Draw where in the motion each env would begin, as a share of its duration."""
        return view.uniform(1, *self.start_range)[:, 0]


@dataclass(frozen=True, kw_only=True)
class ShowMotion(OfMotion, EventTerm):
    """Put the whole scene into the state that a reference motion has at this env step; from its end it begins again.

    In an env whose episodes last one step it plays the motion exactly: `showing_motion` makes one of any config.
    """

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        motion = view.motion(self.file)
        passed = torch.remainder(view.step_count * view.step_dt, motion.duration_s)
        qpos_EL, qvel_EL = motion.sample(passed.to(torch.float32).expand(view.num_envs))
        view.write_qpos(mask_E, qpos_EL if motion_shift(view) is None else view.at_origins(qpos_EL))
        view.write_qvel(mask_E, qvel_EL)
