"""These commands steer what walks: planar velocities, the rhythm of a gait, and what a person sets."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegative, NonNegativeRange, Range, Share
from ksim_rl.checks import check_pair
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfEntity
from ksim_rl.scene import quaternion
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, Rgba

_COMMANDED: Rgba = (0.2, 0.6, 0.2, 0.8)
_REACHED: Rgba = (0.2, 0.3, 0.8, 0.8)


@dataclass(frozen=True, kw_only=True)
class UniformVelocityCommand(OfEntity, CommandTerm):
    """A planar velocity (vx, vy, wz) in the root's frame, m/s and rad/s, [E, 3], drawn uniformly.

    Each resampling makes some envs special, independently of each other:

    * forward: `vx = max(|vx|, forward_min_speed)`, `vy = wz = 0`;
    * heading: wz steers to a drawn world heading, `clip(heading_stiffness * heading error, ang_vel_z)`, at every step,
      also where the env is a forward one;
    * standing: all zero, whatever else it is.

    Attributes:
        lin_vel_x, lin_vel_y: m/s.
        ang_vel_z: rad/s; also the bounds of heading control.
        heading: rad, the targets of heading control.
        heading_stiffness: 1/s.
        rel_standing_envs, rel_heading_envs, rel_forward_envs: probabilities.
        forward_min_speed: m/s.
    """

    lin_vel_x: Range
    lin_vel_y: Range
    ang_vel_z: Range
    heading: Range = (-math.pi, math.pi)
    heading_stiffness: NonNegative = 0.5
    rel_standing_envs: Share = 0.0
    rel_heading_envs: Share = 0.0
    rel_forward_envs: Share = 0.0
    forward_min_speed: NonNegative = 0.3

    @property
    def ranges(self) -> Mapping[str, Range]:
        return {name: getattr(self, name) for name in ("lin_vel_x", "lin_vel_y", "ang_vel_z", "heading")}

    def shared_ranges(self, view: EnvView) -> Float[Tensor, "2 7"]:
        """Return the present ranges, and after them three of [0, 1) for the kinds, (low, high) [2, 7]."""
        return view.shared("ranges_2N", tuple(zip(*self.ranges.values(), *[(0.0, 1.0)] * 3, strict=True)))

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # One draw for all: targets in their ranges, then three numbers in [0, 1) that decide the kinds.
        target_E4, kind_E3 = view.uniform(7, *self.shared_ranges(view).unbind(0)).split((4, 3), dim=-1)
        shares_3 = (self.rel_standing_envs, self.rel_heading_envs, self.rel_forward_envs)
        is_kind_E3 = kind_E3 < constant(shares_3, view.device)
        speed_E1 = target_E4[:, :1].abs().clamp(min=self.forward_min_speed)
        forward_E3 = speed_E1 * constant((1.0, 0.0, 0.0), view.device)
        velocity_E3 = torch.where(is_kind_E3[:, 2:], forward_E3, target_E4[:, :3])

        drawn_E4 = torch.cat((velocity_E3, target_E4[:, 3:]), dim=-1)
        held_E4, held_E2 = self._target(view), self._kind(view)
        held_E4.copy_(torch.where(mask_E[:, None], drawn_E4, held_E4))
        held_E2.copy_(torch.where(mask_E[:, None], is_kind_E3[:, :2], held_E2))

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        target_E4, kind_E2 = self._target(view), self._kind(view)
        error_E = quaternion.wrap_to_pi(target_E4[:, 3] - view.entity(self.entity).heading_E)
        steer_E = (self.heading_stiffness * error_E).clamp(*self.shared_ranges(view)[:, 2].unbind())
        wz_E = torch.where(kind_E2[:, 1], steer_E, target_E4[:, 2])
        command_E3 = torch.cat((target_E4[:, :2], wz_E[:, None]), dim=-1)
        return torch.where(kind_E2[:, :1], 0.0, command_E3)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the commanded (green) and the actual (blue) planar velocity above the root, 0.5 m per m/s."""
        robot = view.entity(self.entity)
        above = robot.root_pos_EL[env_index] + constant((0.0, 0.0, 0.3), view.device)
        command_E3, actual_E3 = self(view), robot.root_lin_vel_b_EL
        for velocity_E3, rgba in ((command_E3, _COMMANDED), (actual_E3, _REACHED)):
            planar_E3 = torch.cat((velocity_E3[:, :2], torch.zeros_like(velocity_E3[:, :1])), dim=-1)
            arrow_E3 = 0.5 * quaternion.rotate(robot.root_quat_EL, planar_E3)
            start = above.cpu().numpy()
            visualizer.arrow(start, start + np.asarray(arrow_E3[env_index].cpu()), rgba=rgba)

    def _target(self, view: EnvView) -> Tensor:
        """Drawn vx, vy, wz and heading, [E, 4]."""
        return view.buffer("target_E4", 4)

    def _kind(self, view: EnvView) -> Tensor:
        """Whether each env stands and whether it is heading-controlled, bool [E, 2]."""
        return view.buffer("kind_E2", 2, dtype=torch.bool)


@dataclass(frozen=True, kw_only=True)
class SinusoidalGaitCommand(CommandTerm):
    """sin and cos of each foot's phase angle: all sines, then all cosines, [E, 2F].

    The angle of foot f is 2 pi (the integral of the frequency since the start of the episode + offset_f); a foot whose
    sine is positive should be in the air. The frequency is drawn per env; a new one changes the pace without a jump.

    Attributes:
        frequency: Hz.
        offsets: one per foot, in cycles: (0.0, 0.5) is a biped's walk, (0.0, 0.5, 0.5, 0.0) a trot.
    """

    frequency: NonNegativeRange
    offsets: tuple[float, ...]
    resampling_time_range_s: NonNegativeRange | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.offsets:
            raise ValueError("offsets=(): give one per foot, such as (0.0, 0.5)")

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        return {"frequency": self.frequency}

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw frequencies for the rows of `mask_E`; their phases go on from where they are."""
        held_E3 = self._held(view)
        drawn_E1 = view.uniform(1, *self.shared_ranges(view).unbind(0))
        fresh_E3 = torch.cat((drawn_E1, view.episode_time_E[:, None], self._cycles(view)[:, None]), dim=-1)
        held_E3.copy_(torch.where(mask_E[:, None], fresh_E3, held_E3))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return the command of the present time, float32 [E, 2F]."""
        offsets_F = constant(self.offsets, view.device)
        angle_EF = 2.0 * math.pi * (self._cycles(view)[:, None] + offsets_F)
        return torch.cat((torch.sin(angle_EF), torch.cos(angle_EF)), dim=-1)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Write which feet should be in the air above the first robot's root: a 1 or a 0 for each."""
        x, y, z = view.root_pos_EL[env_index].tolist()
        sines = self(view)[env_index, : len(self.offsets)].tolist()
        visualizer.text((x, y, z + 0.3), "in the air: " + " ".join(str(int(sine > 0.0)) for sine in sines))

    def _cycles(self, view: EnvView) -> Tensor:
        """Cycles since the start of the episode, modulo 1, [E]."""
        frequency_E, since_E, cycles_E = self._held(view).unbind(-1)
        return torch.remainder(cycles_E + frequency_E * (view.episode_time_E - since_E), 1.0)

    def _held(self, view: EnvView) -> Tensor:
        """Frequency (Hz), time of its drawing (s), and cycles at that time, [E, 3]."""
        return view.buffer("rhythm_E3", 3)


@dataclass(frozen=True, kw_only=True)
class JoystickCommand(CommandTerm):
    """What was last set from outside, clamped to each axis' range, [E, K]; 0 at first, and kept over resets.

    Set it between two steps with `env.command_manager.set(name, values)`; the next observation shows it. So a policy
    that was trained on a drawn command of the same columns can be steered by hand.

    Attributes:
        axes: (low, high) by name, in the order of the columns, such as `{"vx": (-1.0, 1.0), "wz": (-0.5, 0.5)}`; units
            are those of the command that it stands in for.
    """

    axes: Mapping[str, tuple[float, float]]
    resampling_time_range_s: NonNegativeRange | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.axes:
            raise ValueError("axes={}: name at least one, such as {'vx': (-1.0, 1.0)}")
        for name, pair in self.axes.items():
            check_pair(f"axes.{name}", pair)
        if self.resampling_time_range_s is not None:
            raise ValueError(
                f"resampling_time_range_s={self.resampling_time_range_s!r}: it is set, never drawn; leave it out"
            )

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """The axes' limits, which a curriculum may change."""
        return self.axes

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw nothing: what was set stays."""

    def set(self, view: EnvView, value_EK: Float[Tensor, "*rows K"], mask_E: Bool[Tensor, " E"]) -> None:
        """Take values [E, K], or [K] for all alike, for the rows of `mask_E`.

        Raises:
            ValueError: if there is not one column per axis, or a value is not finite (read on the host).
        """
        held_EK = self._held(view)
        if tuple(value_EK.shape) not in (held_EK.shape[1:], held_EK.shape):
            raise ValueError(
                f"values of shape {tuple(value_EK.shape)}: expected [{len(self.axes)}], the axes {list(self.axes)}, "
                f"or {list(held_EK.shape)}"
            )
        if not bool(torch.isfinite(value_EK).all()):
            raise ValueError("values hold a number that is not finite: give finite ones")
        held_EK.copy_(torch.where(mask_E[:, None], value_EK.to(held_EK), held_EK))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        low_K, high_K = self.shared_ranges(view).unbind(0)
        return torch.clamp(self._held(view), low_K, high_K)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Write each axis' value above the first robot's root."""
        x, y, z = view.root_pos_EL[env_index].tolist()
        values = zip(self.axes, self(view)[env_index].tolist(), strict=True)
        visualizer.text((x, y, z + 0.3), ", ".join(f"{axis} {value:+.2f}" for axis, value in values))

    def _held(self, view: EnvView) -> Tensor:
        return view.buffer("held_EK", len(self.axes), keep=True)
