"""Starts episodes inside of a reference motion, away from its states, and more often where robots have failed."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.checked import NonNegative, Positive, Share
from ksim_rl.envs.term import CurriculumTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.events import Ranges, draw_by_axis
from ksim_rl.mdp.motion_tracking import OfMotion, ResetToMotion
from ksim_rl.scene import quaternion
from ksim_rl.scene.state.motion_clock import motion_time


def part_weights(view: EnvView, file: str, parts: int) -> Float[Tensor, "E B"]:
    """Return the buffer of how much likelier than others each part of a motion is as a start; `FailedParts` writes it.

    Parts are of equal length. Zeros stand for parts that are all alike.
    """
    return view.buffers.get(f"motion/{file}.part_weights_EB", parts, keep=True)


def parts_of(view: EnvView, file: str, part_s: float) -> int:
    """Return how many parts of about `part_s` seconds a motion has."""
    # Rounded up: all parts are equally long, and none is longer than asked for.
    return max(1, math.ceil(view.motion(file).duration_s / part_s - 1e-6))


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

    def draw_share(self, view: EnvView) -> Float[Tensor, " E"]:
        """Draw it from the curriculum's weights where there are some, else from the range."""
        # Two draws: one chooses the part, one the place in it.
        drawn_E2 = view.uniform(2)
        low, high = self.start_range
        plain_E = low + (high - low) * drawn_E2[:, 0]
        if self.part_s is None:
            return plain_E
        parts = parts_of(view, self.file, self.part_s)
        reach_EB = torch.cumsum(part_weights(view, self.file, parts), dim=-1)
        # Not a probability yet: weights need not add up to 1.
        whole_E = reach_EB[:, -1]
        # The first part whose cumulated weight exceeds the draw.
        is_past_EB = drawn_E2[:, :1] * whole_E[:, None] >= reach_EB
        part_E = is_past_EB.sum(-1).clamp(max=parts - 1)
        # Zeros, before the curriculum has run, mean a start from the plain range.
        return torch.where(whole_E > 0.0, (part_E + drawn_E2[:, 1]) / parts, plain_E)


@dataclass(frozen=True, kw_only=True)
class FailedParts(OfMotion, CurriculumTerm):
    """Lets episodes begin more often in the parts of a motion where failures end them; `StartInMotion` reads it.

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
        parts = parts_of(view, self.file, self.part_s)
        # Shared by all envs: one count for each part, 1 at first.
        failed_B = view.shared("failed_B", [1.0] * parts)
        weights_EB = part_weights(view, self.file, parts)
        # The very first resets end no episode.
        lived_E = mask_E & (view.episode_step_E > 0)
        share_E = motion_time(view, self.file) / view.motion(self.file).duration_s
        # Where the episode was when it ended: the clock is still the old one here.
        part_E = (share_E * parts).long().clamp(0, parts - 1)
        is_here_EB = part_E[:, None] == torch.arange(parts, device=view.device)
        # Only failures count; motions that were finished say nothing about where it is hard.
        failed_E = lived_E & view.terminated_E
        counts_B = (is_here_EB & failed_E[:, None]).sum(0).to(torch.float32)
        # All ranks learn from all failures.
        ranks.sum_(counts_B)
        # An exponential mean over resets; nothing is read back from the device.
        mixed_B = failed_B + (counts_B - failed_B) / self.memory
        failed_B.copy_(torch.where(ranks.any_of(lived_E), mixed_B, failed_B))
        # A share is even over all parts, so that none is forgotten.
        share_of_failures_B = failed_B / failed_B.sum().clamp(min=1e-9)
        chance_B = self.uniform / parts + (1.0 - self.uniform) * share_of_failures_B
        weights_EB.copy_(torch.where(mask_E[:, None], chance_B, weights_EB))
        return chance_B.max() / chance_B.sum()
