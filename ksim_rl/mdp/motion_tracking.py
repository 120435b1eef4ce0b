"""These terms begin, read, rate and end episodes that follow a reference motion.

`file` is a motion that `view.motion` reads. Kernels are from Peng et al., "DeepMimic" (2018), with scales k written as
std = 1 / sqrt(k): joint positions 2, joint velocities 0.1, ends of limbs 40, root or centre of mass 10.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ksim_rl.checked import Positive, Within, named_files
from ksim_rl.checks import near
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.envs.term import EventTerm, MetricTerm, ObservationTerm, Term, TerminationTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import GaussianReward, OfJoints
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.motion_clock import (
    motion_bodies,
    motion_clip,
    motion_end,
    motion_joints,
    motion_shift,
    motion_start_time,
    motion_time,
)


@dataclass(frozen=True, kw_only=True)
class OfMotion(Term):
    """A term of a reference motion."""

    file: str

    def data_files(self) -> Sequence[str]:
        """Return the name of the motion, of its file or of a set."""
        return (self.file,)


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
        cycle_s = self.cycle_s or motion_end(view, self.file)
        angle_E = motion_time(view, self.file) * (2.0 * math.pi / cycle_s)
        return torch.stack((torch.sin(angle_E), torch.cos(angle_E)), dim=-1)


@dataclass(frozen=True, kw_only=True)
class MotionJoints(OfMotion, OfJoints, ObservationTerm):
    """Positions (rad or m), then velocities (per s), that joints have in the motion `ahead_s` from now, [E, 2L].

    Of several moments one is behind the other, [E, 2LN].
    """

    ahead_s: float | tuple[float, ...] = 0.0

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.ahead_s == ():
            raise ValueError("ahead_s=(): name one moment or more, 0.0 for the present one")

    def __call__(self, view: EnvView) -> Float[Tensor, "E L"]:
        moments = self.ahead_s if isinstance(self.ahead_s, tuple) else (self.ahead_s,)
        index = view.joints(self.joints).index
        clip_E = motion_clip(view, self.file)
        seen: list[Tensor] = []
        for ahead_s in moments:
            if ahead_s == 0.0:
                # The present frame is sampled once per step for all terms.
                seen += motion_joints(view, self.file, self.joints)
                continue
            time_E = motion_time(view, self.file) + ahead_s
            # Positions, then velocities, both of the later moment.
            seen += view.motion(self.file).sample_joints(time_E, index, clip_E)
        return torch.cat(seen, dim=-1)


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
        return motion_time(view, self.file) > motion_end(view, self.file) - 0.5 * view.step_dt


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
        clip_E = motion_clip(view, self.file)
        drawn_E, share_E = self.draw_start(view)
        # Rows that are not reset keep their clip and their start: their clock goes on from it.
        if clip_E is not None and drawn_E is not None:
            clip_E.copy_(torch.where(mask_E, drawn_E, clip_E))
        begin_E = share_E * motion.duration_of(drawn_E)
        start_E.copy_(torch.where(mask_E, begin_E, start_E))
        qpos_EL, qvel_EL = motion.sample(start_E, clip_E)
        # Motions are recorded around the world's origin; on a terrain each env has its own origin.
        view.write_qpos(mask_E, qpos_EL if motion_shift(view) is None else view.at_origins(qpos_EL))
        view.write_qvel(mask_E, qvel_EL)

    def draw_start(self, view: EnvView) -> tuple[Int64[Tensor, " E"] | None, Float[Tensor, " E"]]:
        """Draw which clip each env would follow, None of a single one, and where it begins, a share of its duration."""
        share_E = view.uniform(1, *self.start_range)[:, 0]
        return self.draw_clip(view), share_E

    def draw_clip(self, view: EnvView) -> Int64[Tensor, " E"] | None:
        """Draw a clip that is not held out for each env, all alike; None where the motion is a single one."""
        held_out = view.motion(self.file).held_out
        if len(held_out) == 1:
            return None
        trained = [float(clip) for clip, is_held_out in enumerate(held_out) if not is_held_out]
        trained_C = constant(trained, view.device).long()
        place_E = (view.uniform(1)[:, 0] * len(trained)).long()
        # A draw close to 1 may be rounded up to the end.
        return trained_C[place_E.clamp(max=len(trained) - 1)]


@dataclass(frozen=True, kw_only=True)
class ResetByChoice(ResetToMotion):
    """Begin each episode in the clip, and at the time, that are chosen for its env.

    To choose, write both buffers, or call `choose`.

    Attributes:
        clip: of a set of motions, the one that is chosen at first; empty: the first.
    """

    clip: str = ""

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.start_range != (0.0, 1.0):
            raise ValueError(
                f"start_range={self.start_range}: a {type(self).__name__} begins where it is set, and draws nothing: "
                "leave it out"
            )

    def chosen_clip(self, view: EnvView) -> Int64[Tensor, " E"]:
        """Return the buffer of the clip that is chosen for each env."""
        names = view.motion(self.file).names
        place = 0
        if self.clip:
            if self.clip not in names:
                raise ValueError(
                    f"motion {self.file}: no clip {self.clip!r}: {near(self.clip, names)}"
                )
            place = names.index(self.clip)
        return view.buffers.get(
            f"motion/{self.file}.chosen_clip_E",
            dtype=torch.int64,
            keep=True,
            initial=constant((float(place),), view.device).long(),
        )

    def chosen_time(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return the buffer of when in its clip each env is to begin, s."""
        return view.buffers.get(f"motion/{self.file}.chosen_time_E", keep=True)

    def choose(self, view: EnvView, clip: int, time_s: float) -> None:
        """Let all envs begin at this time of this clip when they are reset next."""
        self.chosen_clip(view).fill_(clip)
        self.chosen_time(view).fill_(time_s)

    def begin_time(self, view: EnvView, duration_E: Float[Tensor, "*E"]) -> Float[Tensor, " E"]:
        """Return when in its clip each env begins now, s; the clips last `duration_E`."""
        return torch.minimum(self.chosen_time(view).clamp(min=0.0), duration_E)

    def draw_start(self, view: EnvView) -> tuple[Int64[Tensor, " E"] | None, Float[Tensor, " E"]]:
        """Return what was chosen."""
        motion = view.motion(self.file)
        clip_E = self.chosen_clip(view)
        duration_E = motion.duration_of(clip_E)
        share_E = self.begin_time(view, duration_E) / duration_E
        return (clip_E if len(motion.names) > 1 else None), share_E


@dataclass(frozen=True, kw_only=True)
class ShowMotion(ResetByChoice):
    """Put the whole scene into the state that the chosen clip has at this env step; from its end it begins again.

    In an env whose episodes last one step it plays the motion exactly: `showing_motion` makes one of any config.
    """

    def choose(self, view: EnvView, clip: int, time_s: float) -> None:
        """Let all envs be at this time of this clip now, and go on from there."""
        super().choose(view, clip, time_s)
        self.chosen_time(view).sub_(view.step_count * view.step_dt)

    def begin_time(self, view: EnvView, duration_E: Float[Tensor, "*E"]) -> Float[Tensor, " E"]:
        """Return how far the env steps have come since the time that was chosen, s."""
        passed_E = self.chosen_time(view) + view.step_count * view.step_dt
        return torch.remainder(passed_E, duration_E)


def with_motions_in_use(cfg: ManagerBasedRlEnvCfg) -> ManagerBasedRlEnvCfg:
    """Return a config some of whose terms were taken away, without the sets of motions that no other one names."""
    named = named_files(cfg)
    motions = {name: chosen for name, chosen in cfg.scene.motions.items() if name in named}
    return dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, motions=motions))


@dataclass(frozen=True, kw_only=True)
class PoseDistance(OfMotion, MetricTerm):
    """The root mean square of the joint angles' distance to the nearest pose of a motion, rad, [E]; position stage."""

    joints: Patterns

    def __call__(self, view: EnvView) -> Float[Tensor, " E"]:
        joints = view.joints(self.joints)
        # All frames of the motion, in the order of the joints.
        poses_FL = view.motion(self.file).joint_pos_FL[:, joints.index]
        own_EL = joints.pos_EL
        # By matrix products, the default for many frames, near poses would lose their digits, on a GPU all but two.
        exactly = "donot_use_mm_for_euclid_dist"
        distance_EF = torch.cdist(own_EL, poses_FL, compute_mode=exactly)
        # Root mean square over joints, at the nearest frame.
        return distance_EF.amin(-1) / own_EL.shape[-1] ** 0.5
