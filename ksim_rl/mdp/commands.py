"""These commands steer robots, set the rhythm of a gait, and ask for poses of a root, joints, a body or site."""

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Filled, NonNegative, NonNegativeRange, Range, Share
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import InFrame, OfEntity, root_height
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, Rgba


@dataclass(frozen=True, kw_only=True)
class OfTarget(InFrame):
    """A term of a body or site and of the position that a command asks it to take.

    Attributes:
        command: a position, with an orientation or not, such as `CartesianCommand` or `StartPoseCommand`, in `frame`.
        body, site: the element that should be there; name one of the two.
    """

    command: str
    body: str | None = None
    site: str | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if (self.body is None) == (self.site is None):
            raise ValueError(f"body={self.body!r}, site={self.site!r}: name exactly one of the two")

    def offset(self, view: EnvView) -> Float[Tensor, "E 3"]:
        """Return the commanded position minus where the body or site is, world frame, m; position stage."""
        target_E3, _ = target_pose_w(view, view.command(self.command), frame=self.frame, entity=self.entity)
        if self.body is not None:
            point = view.body(self.body)
        else:
            point = view.site(str(self.site))
        return target_E3 - point.pos_EL

    def distance(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return how far the body or site is from the commanded position, m; position stage."""
        return torch.linalg.vector_norm(self.offset(view), dim=-1)


def target_pose_w(
    view: EnvView, target_EK: Float[Tensor, "E K"], *, frame: Literal["root", "world"], entity: str = ""
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 4"] | None]:
    """Return a target's position in the world frame, m, and its quaternion there if the target has one.

    `target_EK` is a position [E, 3], or position and quaternion (w, x, y, z) [E, 7], in the frame of `InFrame`.
    """
    pos_E3 = target_EK[:, :3]
    # Seven numbers are position and quaternion; three are a position alone.
    if target_EK.shape[1] == 7:
        quat_E4 = target_EK[:, 3:]
    else:
        quat_E4 = None
    if frame == "world":
        return pos_E3, quat_E4
    root = view.entity(entity)
    # From the root's frame into the world: rotate first, then move by the root's position.
    pos_E3 = root.root_pos_EL + quaternion.rotate(root.root_quat_EL, pos_E3)
    return pos_E3, None if quat_E4 is None else quaternion.multiply(root.root_quat_EL, quat_E4)


_WANTED: Rgba = (0.2, 0.6, 0.2, 0.5)
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, kw_only=True)
class HeldCommand(CommandTerm):
    """A command that stays as it was drawn until it is drawn again."""

    @abstractmethod
    def held(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return the buffer of the drawn values."""

    @abstractmethod
    def draw(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return new values for all rows."""

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # Drawn for all rows, since shapes must not depend on the mask.
        drawn_EK = self.draw(view)
        held_EK = self.held(view)
        # In place, since captured steps hold on to the buffer.
        held_EK.copy_(torch.where(mask_E[:, None], drawn_EK, held_EK))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        # A copy, for the buffer changes at the next resampling.
        return self.held(view).clone()


@dataclass(frozen=True, kw_only=True)
class BaseHeightCommand(OfEntity, HeldCommand):
    """A height of the root body's frame above the ground, m, [E, 1], drawn uniformly."""

    drawn = ("height",)

    height: Range

    def held(self, view: EnvView) -> Float[Tensor, "E 1"]:
        return view.buffer("height_E1", 1)

    def draw(self, view: EnvView) -> Float[Tensor, "E 1"]:
        # Read at each draw: a curriculum may have moved the ranges.
        return view.uniform(1, *self.shared_ranges(view).unbind(0))

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw a ball at the commanded height, in line with the root."""
        # The command counts from the ground and the root from the world's origin, so that only their
        # difference is drawn.
        x, y, z = view.entity(self.entity).root_pos_EL[env_index].tolist()
        rise = float(self.held(view)[env_index, 0] - root_height(view, self.entity)[env_index])
        visualizer.sphere((x, y, z + rise), radius=0.03, rgba=_WANTED)


@dataclass(frozen=True, kw_only=True)
class JointPositionCommand(HeldCommand):
    """Positions of joints, rad or m, [E, N]: the default pose plus a uniform offset, kept inside the soft limits."""

    drawn = ("offset",)

    joints: Patterns
    offset: Range

    def held(self, view: EnvView) -> Float[Tensor, "E N"]:
        return view.buffer("pos_EN", len(view.joints(self.joints)))

    def draw(self, view: EnvView) -> Float[Tensor, "E N"]:
        joints = view.joints(self.joints)
        default_EN = joints.default_pos_EL
        limits_N2 = joints.soft_limits_L2
        offset_EN = view.uniform(default_EN.shape[1], *self.shared_ranges(view).unbind(0))
        # The offset may lead out of the soft limits where the default pose is near to one.
        return torch.clamp(default_EN + offset_EN, limits_N2[:, 0], limits_N2[:, 1])

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        # The ghost is the present pose in all but the commanded joints.
        qpos_L = view.world.qpos_EL[env_index].clone()
        qpos_L[view.joints(self.joints).qpos] = self.held(view)[env_index]
        visualizer.ghost(qpos_L.cpu().numpy(), rgba=_WANTED)


@dataclass(frozen=True, kw_only=True)
class CartesianCommand(InFrame, HeldCommand):
    """Where a body or site should be: a position, m, [E, 3], and if asked its orientation (w, x, y, z) too, [E, 7].

    Ranges are in m and rad by axis, an axis that is left out is 0; the rotation is Rz(yaw) Ry(pitch) Rx(roll).
    """

    position: Mapping[Literal["x", "y", "z"], Range]
    orientation: Mapping[Literal["roll", "pitch", "yaw"], Range] | None = None

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """The ranges that a curriculum may change, of all axes that the command has, x, y, z, roll, pitch, yaw."""
        parts = (self.position, self.orientation or {})
        given: dict[str, Range] = {axis: pair for part in parts for axis, pair in part.items()}
        # An orientation is drawn as three angles, but held as a quaternion of four numbers.
        axes = _AXES[: 3 if self.orientation is None else 6]
        return {axis: given.get(axis, (0.0, 0.0)) for axis in axes}

    def held(self, view: EnvView) -> Float[Tensor, "E K"]:
        return view.buffer("target_EK", 3 if self.orientation is None else 7)

    def draw(self, view: EnvView) -> Float[Tensor, "E K"]:
        drawn_EK = view.uniform(len(self.ranges), *self.shared_ranges(view).unbind(0))
        if self.orientation is None:
            return drawn_EK
        # Columns 3 to 5 are roll, pitch and yaw.
        quat_E4 = quaternion.from_euler_xyz(*drawn_EK[:, 3:].unbind(-1))
        return torch.cat((drawn_EK[:, :3], quat_E4), dim=-1)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the target: a ball and, if an orientation is commanded, its axes."""
        pos_E3, quat_E4 = target_pose_w(view, self.held(view), frame=self.frame, entity=self.entity)
        origin = pos_E3[env_index].cpu().numpy()
        visualizer.sphere(origin, radius=0.03, rgba=_WANTED)
        if quat_E4 is not None:
            visualizer.frame(origin, _axes(quat_E4[env_index]))


@dataclass(frozen=True, kw_only=True)
class StartPoseCommand(OfEntity, CommandTerm):
    """The root's pose at the start of the episode, world frame: position, m, and quaternion (w, x, y, z), [E, 7].

    With a resampling range, the pose at the last resampling. For tasks that stay in place, or return to it.
    """

    resampling_time_range_s: NonNegativeRange | None = None

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Mark the rows of `mask_E`: their pose is read once it is up to date."""
        # Not read here: a reset has just written the state, and poses of bodies lag behind it.
        self._is_due(view).logical_or_(mask_E)

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        robot = view.entity(self.entity)
        is_due_E = self._is_due(view)
        held_E7 = view.buffer("pose_E7", 7)
        pose_E7 = torch.cat((robot.root_pos_EL, robot.root_quat_EL), dim=-1)
        # Only the rows that are due take over the present pose.
        held_E7.copy_(torch.where(is_due_E[:, None], pose_E7, held_E7))
        # Each mark counts once.
        is_due_E.zero_()
        return held_E7.clone()

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        pose_7 = view.buffer("pose_E7", 7)[env_index]
        visualizer.frame(pose_7[:3].cpu().numpy(), _axes(pose_7[3:]), scale=0.2)

    def _is_due(self, view: EnvView) -> Tensor:
        return view.buffer("is_due_E", dtype=torch.bool)


def _axes(quat_4: Tensor) -> np.ndarray:
    """Return the rotation matrix [3, 3] of a quaternion [4]."""
    # Rotated unit vectors are the columns of the matrix, hence the transpose.
    return quaternion.rotate(quat_4.expand(3, 4), torch.eye(3, device=quat_4.device)).T.cpu().numpy()


_COMMANDED: Rgba = (0.2, 0.6, 0.2, 0.8)
VELOCITY = ("lin_vel_x", "lin_vel_y", "ang_vel_z", "heading")
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
        return view.shared("ranges_2N", tuple(zip(*self.ranges.values(), *[(0.0, 1.0)] * 3, strict=True)))

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        # One draw for all: targets in their ranges, then three numbers in [0, 1) that decide the kinds.
        target_E4, kind_E3 = view.uniform(7, *self.shared_ranges(view).unbind(0)).split((4, 3), dim=-1)
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

    def __call__(self, view: EnvView) -> Float[Tensor, "E 3"]:
        target_E4 = self._target(view)
        kind_E2 = self._kind(view)
        # By the shorter way round.
        error_E = quaternion.wrap_to_pi(target_E4[:, 3] - view.entity(self.entity).heading_E)
        # Steering stays inside the present range of wz, column 2.
        steer_E = (self.heading_stiffness * error_E).clamp(*self.shared_ranges(view)[:, 2].unbind())
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
            planar_E3 = torch.cat((velocity_E3[:, :2], torch.zeros_like(velocity_E3[:, :1])), dim=-1)
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


@dataclass(frozen=True, kw_only=True)
class SinusoidalGaitCommand(CommandTerm):
    """sin and cos of each foot's phase angle: all sines, then all cosines, [E, 2F].

    The angle of foot f is 2 pi (the integral of the frequency since the start of the episode + offset_f); a foot whose
    sine is positive should be in the air. The frequency is drawn per env; a new one changes the pace without a jump.

    The frequency is in Hz, offsets in cycles, one per foot: (0.0, 0.5) is a biped's walk, (0.0, 0.5, 0.5, 0.0) a trot.
    """

    drawn = ("frequency",)

    frequency: NonNegativeRange
    offsets: Annotated[tuple[float, ...], Filled("give one per foot, such as (0.0, 0.5)")]
    resampling_time_range_s: NonNegativeRange | None = None

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        held_E3 = self._held(view)
        # A new frequency goes on from the cycles of the old one, so that the phase does not jump.
        drawn_E1 = view.uniform(1, *self.shared_ranges(view).unbind(0))
        fresh_E3 = torch.cat((drawn_E1, view.episode_time_E[:, None], self._cycles(view)[:, None]), dim=-1)
        held_E3.copy_(torch.where(mask_E[:, None], fresh_E3, held_E3))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
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
        # Only the present frequency counts from its drawing on; earlier ones are in `cycles_E`.
        frequency_E, since_E, cycles_E = self._held(view).unbind(-1)
        return torch.remainder(cycles_E + frequency_E * (view.episode_time_E - since_E), 1.0)

    def _held(self, view: EnvView) -> Tensor:
        """Frequency (Hz), time of its drawing (s), and cycles at that time, [E, 3]."""
        return view.buffer("rhythm_E3", 3)


@dataclass(frozen=True, kw_only=True)
class JoystickCommand(CommandTerm):
    """The values last set from outside, clamped to each axis' range, [E, K]; 0 at first, and kept over resets.

    Set it between two steps with `env.command_manager.set(name, values)`; the next observation shows it. So a policy
    that was trained on a drawn command of the same columns can be steered by hand.

    Attributes:
        axes: (low, high) by name, in the order of the columns, such as `{"vx": (-1.0, 1.0), "wz": (-0.5, 0.5)}`; units
            are as in the command that it stands in for.
    """

    axes: Annotated[Mapping[str, Range], Filled("name at least one, such as {'vx': (-1.0, 1.0)}")]
    resampling_time_range_s: NonNegativeRange | None = None

    def _check_fields(self) -> None:
        super()._check_fields()
        if self.resampling_time_range_s is not None:
            raise ValueError(
                f"resampling_time_range_s={self.resampling_time_range_s!r}: it is set, never drawn; leave it out"
            )

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        return self.axes

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw nothing: the values that were set stay."""

    def set(self, view: EnvView, value_EK: Float[Tensor, "*rows K"], mask_E: Bool[Tensor, " E"]) -> None:
        """Take finite values [E, K], or [K] for all alike, for the rows of `mask_E`; they are checked on the host."""
        held_EK = self._held(view)
        if tuple(value_EK.shape) not in (held_EK.shape[1:], held_EK.shape):
            raise ValueError(
                f"values of shape {tuple(value_EK.shape)}: expected [{len(self.axes)}], the axes {list(self.axes)}, "
                f"or {list(held_EK.shape)}"
            )
        # A NaN would reach the policy's observation; reading it here waits for the device, which is fine
        # between steps.
        if not bool(torch.isfinite(value_EK).all()):
            raise ValueError("values hold a number that is not finite: give finite ones")
        held_EK.copy_(torch.where(mask_E[:, None], value_EK.to(held_EK), held_EK))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        # Clamped when read, since a curriculum may have narrowed the ranges since `set`.
        low_K, high_K = self.shared_ranges(view).unbind(0)
        return torch.clamp(self._held(view), low_K, high_K)

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        x, y, z = view.root_pos_EL[env_index].tolist()
        values = zip(self.axes, self(view)[env_index].tolist(), strict=True)
        visualizer.text((x, y, z + 0.3), ", ".join(f"{axis} {value:+.2f}" for axis, value in values))

    def _held(self, view: EnvView) -> Tensor:
        # Kept over resets: whoever steers does not know of them.
        return view.buffer("held_EK", len(self.axes), keep=True)
