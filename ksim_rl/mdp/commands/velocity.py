"""The command of a root's planar velocity."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegative, Range, Share
from ksim_rl.envs.term import CommandRanges, CommandTerm, hull
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.scene import quaternion
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, Rgba

VELOCITY = ("lin_vel_x", "lin_vel_y", "ang_vel_z", "heading")
_COMMANDED: Rgba = (0.2, 0.6, 0.2, 0.8)
_REACHED: Rgba = (0.2, 0.3, 0.8, 0.8)


@dataclass(frozen=True, kw_only=True)
class UniformVelocityCommand(OfEntity, CommandTerm):
    """A planar velocity (vx, vy, wz) in the root's frame, m/s and rad/s, [E, 3], drawn uniformly.

    Each resampling makes some envs special, independently of each other:

    * forward: `vx = max(|vx|, forward_min_speed)`, `vy = wz = 0`;
    * heading: wz steers to a drawn world heading, `clip(heading_stiffness * heading error, ang_vel_z)`, at every step,
      also where the env is a forward one;
    * world: (vx, vy) are in the world's axes, as drawn and not as a forward env has them;
    * standing: all zero, whatever else it is.

    Units are m, rad and s; `ang_vel_z` also bounds heading control, and `rel_..._envs` are probabilities.
    """

    drawn = VELOCITY

    lin_vel_x: Range
    lin_vel_y: Range
    ang_vel_z: Range
    heading: Range = (-math.pi, math.pi)
    heading_stiffness: NonNegative = 0.5
    rel_standing_envs: Share = 0.0
    rel_heading_envs: Share = 0.0
    rel_forward_envs: Share = 0.0
    rel_world_envs: Share = 0.0
    forward_min_speed: NonNegative = 0.3

    def shared_ranges(self, view: EnvView) -> Float[Tensor, "2 7"]:
        """Return the present ranges, and after them three of [0, 1) for the kinds, (low, high) [2, 7]."""
        # Columns: vx, vy, wz, heading, and three for the kinds; one table, so that one draw does for all.
        kinds = [(0.0, 1.0)] * 3
        low_and_high = zip(*self.ranges.values(), *kinds, strict=True)
        return view.shared("ranges_2N", tuple(low_and_high))

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # One draw for all: targets in their ranges, then three numbers in [0, 1) that decide the kinds.
        low_7, high_7 = self.shared_ranges(view).unbind(0)
        target_E4, kind_E3 = view.uniform(7, low_7, high_7).split((4, 3), dim=-1)
        shares_3 = (self.rel_standing_envs, self.rel_heading_envs, self.rel_forward_envs)
        # Columns: standing, heading-controlled, forward.
        is_kind_E3 = kind_E3 < constant(shares_3, view.device)
        # Forward envs keep the drawn speed, but walk at least at the minimum, and never backwards.
        speed_E1 = target_E4[:, :1].abs().clamp(min=self.forward_min_speed)
        forward_E3 = speed_E1 * constant((1.0, 0.0, 0.0), view.device)
        velocity_E3 = torch.where(is_kind_E3[:, 2:], forward_E3, target_E4[:, :3])
        if self.rel_world_envs > 0.0:
            # A draw of its own, so that the others are as without it.
            is_world_E1 = view.uniform(1) < self.rel_world_envs
            held_E1 = self._is_world(view)
            held_E1.copy_(torch.where(mask_E[:, None], is_world_E1, held_E1))
            planar_E2 = torch.where(is_world_E1, target_E4[:, :2], velocity_E3[:, :2])
            velocity_E3 = torch.cat((planar_E2, velocity_E3[:, 2:]), dim=-1)

        # Forward is folded into the velocity; standing and heading control are decided at each step.
        drawn_E4 = torch.cat((velocity_E3, target_E4[:, 3:]), dim=-1)
        held_E4 = self._target(view)
        held_E2 = self._kind(view)
        held_E4.copy_(torch.where(mask_E[:, None], drawn_E4, held_E4))
        held_E2.copy_(torch.where(mask_E[:, None], is_kind_E3[:, :2], held_E2))

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        columns = [[ranges[name]] for name in VELOCITY[:3]]
        if self.rel_standing_envs > 0.0:
            for pairs in columns:
                pairs.append((0.0, 0.0))
        if self.rel_forward_envs > 0.0:
            columns[0].append(self._forward_speeds(*ranges["lin_vel_x"]))
            for pairs in columns[1:]:
                pairs.append((0.0, 0.0))
        if self.rel_world_envs > 0.0:
            # Turned by any heading.
            corner = [max(map(abs, ranges[name])) for name in VELOCITY[:2]]
            speed = math.hypot(*corner)
            for pairs in columns[:2]:
                pairs.append((-speed, speed))
        return [hull(pairs) for pairs in columns]

    def _forward_speeds(self, low: float, high: float) -> tuple[float, float]:
        """Return the least and the greatest speed of forward envs, for a range of vx."""
        ends = sorted((abs(low), abs(high)))
        if low <= 0.0 <= high:
            ends[0] = 0.0
        slowest, fastest = (max(end, self.forward_min_speed) for end in ends)
        return slowest, fastest

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        target_E4 = self._target(view)
        kind_E2 = self._kind(view)
        # By the shorter way round.
        error_E = quaternion.wrap_to_pi(target_E4[:, 3] - view.entity(self.entity).heading_E)
        # Steering stays inside the present range of wz, column 2.
        slowest, fastest = self.shared_ranges(view)[:, 2].unbind()
        steer_E = (self.heading_stiffness * error_E).clamp(slowest, fastest)
        wz_E = torch.where(kind_E2[:, 1], steer_E, target_E4[:, 2])
        planar_E2 = target_E4[:, :2]
        if self.rel_world_envs > 0.0:
            turned_E2 = quaternion.turn_planar(planar_E2, -view.entity(self.entity).heading_E)
            planar_E2 = torch.where(self._is_world(view), turned_E2, planar_E2)
        command_E3 = torch.cat((planar_E2, wz_E[:, None]), dim=-1)
        # Standing comes last: it overrides all other kinds.
        return torch.where(kind_E2[:, :1], 0.0, command_E3)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the commanded (green) and the actual (blue) planar velocity above the root, 0.5 m per m/s."""
        robot = view.entity(self.entity)
        # 0.3 m above the root, clear of the robot's body.
        above = robot.root_pos_EL[env_index] + constant((0.0, 0.0, 0.3), view.device)
        command_E3 = self(view)
        actual_E3 = robot.root_lin_vel_b_EL
        for velocity_E3, rgba in ((command_E3, _COMMANDED), (actual_E3, _REACHED)):
            # Velocities are in the root's frame, pictures in the world's; vertical speed is not part of the
            # command.
            upward_E1 = torch.zeros_like(velocity_E3[:, :1])
            planar_E3 = torch.cat((velocity_E3[:, :2], upward_E1), dim=-1)
            arrow_E3 = 0.5 * quaternion.rotate(robot.root_quat_EL, planar_E3)
            start = above.cpu().numpy()
            visualizer.arrow(start, start + np.asarray(arrow_E3[env_index].cpu()), rgba=rgba)

    def _target(self, view: EnvView) -> Tensor:
        """Drawn vx, vy, wz and heading, [E, 4]."""
        return view.buffer("target_E4", 4)

    def _is_world(self, view: EnvView) -> Tensor:
        """Whether each env's velocity is in the world's axes, bool [E, 1]."""
        return view.buffer("is_world_E1", 1, dtype=torch.bool)

    def _kind(self, view: EnvView) -> Tensor:
        """Whether each env stands and whether it is heading-controlled, bool [E, 2]."""
        return view.buffer("kind_E2", 2, dtype=torch.bool)
