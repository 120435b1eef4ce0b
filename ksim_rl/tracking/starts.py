"""Starts episodes inside of a reference motion, away from its states, and more often where robots have failed."""

import math
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.checked import NonNegative, Positive, Share
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.events import Ranges, draw_by_axis
from ksim_rl.mdp.motion_tracking import OfMotion, ResetByChoice, ResetToMotion
from ksim_rl.scene import quaternion
from ksim_rl.scene.state.motion_clock import motion_clip, motion_end, motion_time


@dataclass(frozen=True, kw_only=True)
class Parts:
    """The B parts of the clips of a motion that training sees: of equal length within a clip, one clip after the other.

    Attributes:
        clip_B: the clip of each part.
        place_B: the number of each part within its clip.
        first_C, count_C: the first part of each clip, and how many it has; none of held-out clips.
        part_s: the length that was asked for, s.
    """

    clip_B: Int64[Tensor, " B"]
    place_B: Float[Tensor, " B"]
    first_C: Int64[Tensor, " C"]
    count_C: Float[Tensor, " C"]
    part_s: float

    def __len__(self) -> int:
        return len(self.clip_B)


# Per view, by motion; made while the env is constructed.
_PARTS: WeakKeyDictionary[EnvView, dict[str, Parts]] = WeakKeyDictionary()


def parts_of(view: EnvView, file: str, part_s: float) -> Parts:
    """Return the parts of a motion, about `part_s` seconds each; a ValueError if they already have another length."""
    found = _PARTS.setdefault(view, {})
    if file in found:
        # Else failures would be counted in other parts than starts are drawn from.
        if found[file].part_s != part_s:
            raise ValueError(
                f"part_s={part_s:g} of motion {file}, and {found[file].part_s:g} elsewhere: give StartInMotion and "
                "FailedParts the same one"
            )
        return found[file]
    motion = view.motion(file)
    counts = []
    for last, held_out in zip(motion.last_C.tolist(), motion.held_out, strict=True):
        # Rounded up: all parts are equally long, and none is longer than asked for.
        parts = max(1, math.ceil(last / motion.fps / part_s - 1e-6))
        counts.append(0 if held_out else parts)
    # Outside of inference mode: the tables outlive the mode of the call that happens to come first.
    with torch.inference_mode(False):
        count_C = torch.tensor(counts, device=view.device)
        first_C = torch.cumsum(count_C, dim=0) - count_C
        clip_B = torch.arange(len(counts), device=view.device).repeat_interleave(count_C)
        place_B = torch.arange(sum(counts), device=view.device) - first_C[clip_B]
        found[file] = Parts(
            clip_B=clip_B,
            place_B=place_B.to(torch.float32),
            first_C=first_C,
            count_C=count_C.to(torch.float32),
            part_s=part_s,
        )
    return found[file]


def drawn_parts(view: EnvView, file: str, part_s: float) -> Parts:
    """Return the parts that starts of a motion are drawn from; a ValueError if none are, as `parts_of`."""
    # Starts are rehearsed before curricula are built.
    if file not in _PARTS.get(view, {}):
        raise ValueError(
            f"FailedParts of motion {file}: no StartInMotion of it draws parts, so that the curriculum would change "
            f"nothing: give one part_s={part_s:g}, or leave the curriculum out"
        )
    return parts_of(view, file, part_s)


def part_weights(view: EnvView, file: str, parts: Parts) -> Float[Tensor, " B"]:
    """Return how much likelier than others each part of a motion is as a start; `FailedParts` writes it.

    Zeros stand for parts that are all alike.
    """
    zeros = [0.0] * len(parts)
    return view.shared(f"motion/{file}.part_weights_B", zeros, of_curriculum=True)


@dataclass(frozen=True, kw_only=True)
class StartInMotion(ResetToMotion):
    """Put the first robot into a state of the motion, plus drawn errors of the root and of each joint.

    Starts are drawn from `start_range`, shares of the motion's duration; where the curriculum `FailedParts` runs, from
    its weights instead.

    Attributes:
        pose_range, velocity_range: errors of the root: x, y, z (m, m/s), roll, pitch, yaw (rad, rad/s), world.
        joint_range: rad added to each joint at most, either way; joints stay in their soft limits.
        part_s: length of the curriculum's parts, s; None: none runs.
    """

    pose_range: Ranges = field(default_factory=dict)
    velocity_range: Ranges = field(default_factory=dict)
    joint_range: NonNegative = 0.0
    part_s: Positive | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.part_s is not None and self.start_range != (0.0, 1.0):
            raise ValueError(
                f"start_range={self.start_range} with part_s={self.part_s:g}: starts follow the curriculum's weights "
                "of parts, and not the range: set part_s=null, and leave the curriculum out"
            )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        super().__call__(view, mask_E)
        robot = view.robot
        joints = view.joints()
        # Velocities are those in the world, as in the motion: they do not turn with the error of the root's pose.
        lin_vel_E3 = robot.root_lin_vel_w_EL
        ang_vel_E3 = robot.root_ang_vel_w_EL
        # Read before the pose is written, since velocities in the world follow from it.
        moved_E6 = draw_by_axis(view, self.pose_range)
        kick_E6 = draw_by_axis(view, self.velocity_range)
        # The error turns the robot about world axes.
        roll_E, pitch_E, yaw_E = moved_E6[:, 3:].unbind(-1)
        turn_E4 = quaternion.from_euler_xyz(roll_E, pitch_E, yaw_E)
        quat_E4 = quaternion.multiply(turn_E4, robot.root_quat_EL)
        pos_E3 = robot.root_pos_EL + moved_E6[:, :3]
        robot.write_root_pose(mask_E, pos_E3, quat_E4)
        lin_vel_E3 = lin_vel_E3 + kick_E6[:, :3]
        ang_vel_E3 = ang_vel_E3 + kick_E6[:, 3:]
        robot.write_root_velocity(mask_E, lin_vel_E3, ang_vel_E3)
        low_L, high_L = joints.soft_limits_L2.unbind(-1)
        off_EL = view.uniform(len(joints), -self.joint_range, self.joint_range)
        # Within the soft limits, where the action can reach.
        joints.write_pos(mask_E, torch.clamp(joints.pos_EL + off_EL, low_L, high_L))

    def draw_start(self, view: EnvView) -> tuple[Int64[Tensor, " E"] | None, Float[Tensor, " E"]]:
        """Draw it from the curriculum's weights where there are some, else from the range."""
        # Two draws: one chooses the part, one the place in it.
        drawn_E2 = view.uniform(2)
        low, high = self.start_range
        plain_E = low + (high - low) * drawn_E2[:, 0]
        plain_clip_E = self.draw_clip(view)
        if self.part_s is None:
            return plain_clip_E, plain_E
        parts = parts_of(view, self.file, self.part_s)
        reach_B = torch.cumsum(part_weights(view, self.file, parts), dim=-1)
        # Not a probability yet: weights need not add up to 1.
        whole = reach_B[-1]
        # The first part whose cumulated weight exceeds the draw.
        part_E = torch.searchsorted(reach_B, drawn_E2[:, 0] * whole, right=True)
        part_E = part_E.clamp(max=len(parts) - 1)
        clip_E = parts.clip_B[part_E]
        share_E = (parts.place_B[part_E] + drawn_E2[:, 1]) / parts.count_C[clip_E]
        # Zeros, before the curriculum has run, mean a start from the plain range.
        has_run = whole > 0.0
        if plain_clip_E is not None:
            plain_clip_E = torch.where(has_run, clip_E, plain_clip_E)
        return plain_clip_E, torch.where(has_run, share_E, plain_E)


@dataclass(frozen=True, kw_only=True)
class StartOfTrial(ResetByChoice, StartInMotion):
    """Begin each episode in the chosen clip, at its start or a chosen time, with the errors of `StartInMotion`."""

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.part_s is not None:
            raise ValueError(
                f"part_s={self.part_s:g}: a StartOfTrial begins where it is set, and draws no part: set it to null"
            )

    def draw_start(self, view: EnvView) -> tuple[Int64[Tensor, " E"] | None, Float[Tensor, " E"]]:
        """Return what was chosen."""
        # Drawn and not used, so that the errors that are drawn next equal `StartInMotion`'s at the same seed.
        view.uniform(2)
        return super().draw_start(view)


@dataclass(frozen=True, kw_only=True)
class FailedParts(OfMotion, CurriculumTerm):
    """Lets episodes begin more often in the clips, and the parts of clips, where failures end them.

    `StartInMotion` reads it. Held-out clips have no parts.
    Reports the share of starts in the part that has most.

    Attributes:
        part_s: length of a part, as in `StartInMotion`, s.
        uniform: share of the starts that are spread evenly over all parts.
        memory: how many resets with a failure or an end are remembered (an exponential mean).
    """

    part_s: Positive = 1.0
    uniform: Share = 0.5
    memory: Positive = 500.0

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> Float[Tensor, ""]:
        parts = drawn_parts(view, self.file, self.part_s)
        # Shared by all envs: one count for each part, 1 at first.
        failed_B = view.shared("failed_B", [1.0] * len(parts))
        weights_B = part_weights(view, self.file, parts)
        # The very first resets end no episode.
        lived_E = mask_E & (view.episode_step_E > 0)
        share_E = motion_time(view, self.file) / motion_end(view, self.file)
        clip_E = motion_clip(view, self.file)
        clip = 0 if clip_E is None else clip_E
        # Where the episode was when it ended: the clock is still the old one here.
        count_E = parts.count_C[clip]
        place_E = torch.minimum((share_E * count_E).floor(), count_E - 1.0).clamp(min=0.0)
        part_E = (parts.first_C[clip] + place_E.long()).clamp(max=len(parts) - 1)
        # Only failures count; motions that were finished say nothing about where it is hard.
        # Held-out clips have no parts, and an env follows one only before its first reset.
        failed_E = (lived_E & view.terminated_E & (count_E > 0.0)).to(torch.float32)
        counts_B = torch.zeros_like(failed_B).index_add(0, part_E, failed_E)
        # All ranks learn from all failures.
        ranks.sum_(counts_B)
        # An exponential mean over resets; nothing is read back from the device.
        mixed_B = failed_B + (counts_B - failed_B) / self.memory
        failed_B.copy_(torch.where(ranks.any_of(lived_E), mixed_B, failed_B))
        # A share is even over all parts, so that none is forgotten.
        share_of_failures_B = failed_B / failed_B.sum().clamp(min=1e-9)
        chance_B = self.uniform / len(parts) + (1.0 - self.uniform) * share_of_failures_B
        weights_B.copy_(torch.where(mask_E.any(), chance_B, weights_B))
        return chance_B.max() / chance_B.sum()
