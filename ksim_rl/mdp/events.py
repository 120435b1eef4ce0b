"""These events reset joints and free roots, and disturb a robot by a kick, by a force that lasts, by a jump."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import Count, NonNegative, NonNegativeRange, Positive, Range, Share
from ksim_rl.checks import check_in_range, check_pair
from ksim_rl.envs.term import EventMode, EventTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp.constants import constant
from ksim_rl.mdp.fields import OfCommand, OfEntity, OfJoints, root_height
from ksim_rl.scene import quaternion

Axis = Literal["x", "y", "z", "roll", "pitch", "yaw"]
Ranges = Mapping[Axis, Range]


def draw_by_axis(view: EnvView, ranges: Ranges) -> Float[Tensor, "E 6"]:
    """Draw x, y, z, roll, pitch, yaw (m and rad, or m/s and rad/s) uniformly; axes that are left out are 0."""
    pairs = [ranges.get(axis, (0.0, 0.0)) for axis in get_args(Axis)]
    low_6 = constant([float(low) for low, _ in pairs], view.device)
    # Nothing to draw, as for a term without ranges: no kernel.
    if all(low == high for low, high in pairs):
        return low_6.expand(view.num_envs, 6)
    high_6 = constant([float(high) for _, high in pairs], view.device)
    return view.uniform(6, low_6, high_6)


@dataclass(frozen=True, kw_only=True)
class JointReset(OfJoints, EventTerm):
    """A reset of joints, whose positions stay in the soft limits."""

    def _write(self, view: EnvView, mask_E: Tensor, pos_EL: Tensor, vel_EL: Tensor) -> None:
        joints = view.joints(self.joints)
        low_L, high_L = joints.soft_limits_L2.unbind(-1)
        # A drawn position beyond a limit would begin the episode with a violent push back.
        joints.write_pos(mask_E, torch.clamp(pos_EL, low_L, high_L))
        joints.write_vel(mask_E, vel_EL)


@dataclass(frozen=True, kw_only=True)
class ResetJoints(JointReset):
    """Put joints at default positions plus an offset, rad or m, at a drawn velocity; "gaussian" ranges: (mean, std)."""

    position_range: tuple[float, float] = (0.0, 0.0)
    velocity_range: tuple[float, float] = (0.0, 0.0)
    distribution: Literal["uniform", "gaussian"] = "uniform"

    def _check_fields(self) -> None:
        super()._check_fields()
        for name in ("position_range", "velocity_range"):
            # A pair means (low, high) or (mean, standard deviation).
            if self.distribution == "uniform":
                check_pair(name, getattr(self, name))
            else:
                check_in_range(f"{name}[1]", getattr(self, name)[1], low=0.0)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        default_EL = view.joints(self.joints).default_pos_EL
        count = default_EL.shape[1]
        pos_EL = default_EL + self._draw(view, count, self.position_range)
        vel_EL = self._draw(view, count, self.velocity_range)
        self._write(view, mask_E, pos_EL, vel_EL)

    def _draw(self, view: EnvView, count: int, pair: tuple[float, float]) -> Float[Tensor, "E L"]:
        first = float(pair[0])
        second = float(pair[1])
        # A range without width needs no draw.
        if second == (0.0 if self.distribution == "gaussian" else first):
            return constant([first] * count, view.device).expand(view.num_envs, count)
        if self.distribution == "gaussian":
            return first + second * view.normal(count)
        return view.uniform(count, first, second)


@dataclass(frozen=True, kw_only=True)
class ResetJointsByScale(JointReset):
    """Put joints at their default positions times a uniform factor, per joint, with a velocity in rad/s or m/s."""

    position_scale: Range
    velocity_range: Range = (0.0, 0.0)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        default_EL = view.joints(self.joints).default_pos_EL
        count = default_EL.shape[1]
        pos_EL = default_EL * view.uniform(count, *self.position_scale)
        vel_EL = view.uniform(count, *self.velocity_range)
        self._write(view, mask_E, pos_EL, vel_EL)


@dataclass(frozen=True, kw_only=True)
class ResetRootUniform(OfEntity, EventTerm):
    """Put the free root body at its default pose, on a terrain at the env's origin, plus uniform offset and velocity.

    `pose_range` is by axis: x, y, z (m, world frame), roll, pitch, yaw (rad, in the default pose's frame), and
    `velocity_range` in m/s and rad/s, world frame.
    """

    pose_range: Ranges = field(default_factory=dict)
    velocity_range: Ranges = field(default_factory=dict)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = view.entity(self.entity)
        offset_E6 = draw_by_axis(view, self.pose_range)
        velocity_E6 = draw_by_axis(view, self.velocity_range)
        turn_E4 = quaternion.from_euler_xyz(*offset_E6[:, 3:].unbind(-1))
        # The turn is on the right: its axes are the default pose's, not the world's.
        default_E4 = body.default_root_quat_L.expand(view.num_envs, 4)
        quat_E4 = quaternion.multiply(default_E4, turn_E4)
        pos_E3 = body.default_root_pos_L + offset_E6[:, :3]
        start_E3 = self.start(view)
        if start_E3 is not None:
            pos_E3 = pos_E3 + start_E3
        body.write_root_pose(mask_E, pos_E3, quat_E4)
        body.write_root_velocity(mask_E, velocity_E6[:, :3], velocity_E6[:, 3:])

    def start(self, view: EnvView) -> Float[Tensor, "E 3"] | None:
        """Return the point on the ground that each env starts from, m, world frame; None for the world's origin."""
        # On flat ground all envs start at the world's origin.
        if view.terrain.is_flat:
            return None
        return view.terrain.origins_E3


@dataclass(frozen=True, kw_only=True)
class ResetRootOnEvenGround(ResetRootUniform):
    """Do as `ResetRootUniform`, but from places all over the patch of a `TerrainGrid` where the ground is even.

    A square of the given `edge` (m) about each place has heights that differ by `max_difference` (m) at most. Each
    patch has `num_places` of them, drawn once, and an env starts at one of its own patch's.
    """

    edge: Positive = 1.0
    max_difference: NonNegative = 0.05
    num_places: Count = 16

    def start(self, view: EnvView) -> Float[Tensor, "E 3"]:
        places_EK3 = view.terrain.places_on_even_ground(
            edge=self.edge, max_difference=self.max_difference, count=self.num_places
        )
        chosen_E1 = view.integers(1, 0, self.num_places - 1)
        chosen_E13 = chosen_E1[..., None].expand(-1, -1, 3)
        return places_EK3.gather(1, chosen_E13)[:, 0]


@dataclass(frozen=True, kw_only=True)
class ResetHeading(OfEntity, EventTerm):
    """Turn the free root body about the world's z axis to a drawn heading (rad), also after `ResetRootUniform`."""

    heading_range: Range = (-math.pi, math.pi)

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = view.entity(self.entity)
        # The default heading does not matter: only the difference from the present one to the drawn one is
        # turned.
        turn_E = view.uniform(1, *self.heading_range)[:, 0] - body.heading_E
        nothing_E = torch.zeros_like(turn_E)
        turn_E4 = quaternion.from_euler_xyz(nothing_E, nothing_E, turn_E)
        # On the left, since it turns about the world's z axis.
        quat_E4 = quaternion.multiply(turn_E4, body.root_quat_EL)
        body.write_root_pose(mask_E, body.root_pos_EL, quat_E4)


@dataclass(frozen=True, kw_only=True)
class ResetHeight(OfEntity, EventTerm):
    """Put the free root body at a drawn height (m) above the ground right below it, also after `ResetRootUniform`."""

    height_range: Range

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = view.entity(self.entity)
        # The root moves by the difference of heights, so that slopes and steps need no special case.
        rise_E1 = view.uniform(1, *self.height_range) - root_height(view, self.entity)[:, None]
        planar_E2 = body.root_pos_EL[:, :2]
        height_E1 = body.root_pos_EL[:, 2:] + rise_E1
        pos_E3 = torch.cat((planar_E2, height_E1), dim=-1)
        body.write_root_pose(mask_E, pos_E3, body.root_quat_EL)


@dataclass(frozen=True, kw_only=True)
class StartAtCommand(OfCommand, OfEntity, EventTerm):
    """Start some episodes at the speed that a velocity command (vx, vy, wz) asks for, all else of the root's at rest.

    `share` is the probability. So a fast gait is met before the policy can reach it by itself.
    """

    mode: EventMode = "start"
    share: Share = 0.5

    def _check_fields(self) -> None:
        super()._check_fields()
        # Where events of resets run, the command of the episode is not drawn yet.
        if self.mode != "start":
            raise ValueError(f"mode={self.mode!r}: expected 'start', when the command is there")

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = view.entity(self.entity)
        command_E3 = view.command(self.command)
        nothing_E1 = torch.zeros_like(command_E3[:, :1])
        planar_E3 = torch.cat((command_E3[:, :2], nothing_E1), dim=-1)
        turn_E3 = torch.cat((nothing_E1, nothing_E1, command_E3[:, 2:]), dim=-1)
        # The command is in the root's frame, velocities are written in the world's.
        quat_E4 = body.root_quat_EL
        starts_E = mask_E & (view.uniform(1)[:, 0] < self.share)
        lin_vel_E3 = quaternion.rotate(quat_E4, planar_E3)
        ang_vel_E3 = quaternion.rotate(quat_E4, turn_E3)
        body.write_root_velocity(starts_E, lin_vel_E3, ang_vel_E3)


@dataclass(frozen=True, kw_only=True)
class PushByVelocity(OfEntity, EventTerm):
    """Kick the free root body: add a uniform draw to its velocity (m/s and rad/s, world frame), whatever its mass."""

    mode: EventMode = "interval"
    velocity_range: Ranges

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = view.entity(self.entity)
        kick_E6 = draw_by_axis(view, self.velocity_range)
        # Added to the present velocity, not in place of it.
        lin_vel_E3 = body.root_lin_vel_w_EL + kick_E6[:, :3]
        ang_vel_E3 = body.root_ang_vel_w_EL + kick_E6[:, 3:]
        body.write_root_velocity(mask_E, lin_vel_E3, ang_vel_E3)


@dataclass(frozen=True, kw_only=True)
class PushByForce(EventTerm):
    """Press on a body for a while with a constant wrench at its centre of mass; both are drawn when the interval ends.

    A push that is due while another lasts replaces it. Several of these events on one body add up. `wrench_range` is by
    axis: x, y, z (N), roll, pitch, yaw (N m), world frame; `duration_s` is rounded to env steps, at least one.
    """

    mode: EventMode = "interval"
    body: str
    wrench_range: Ranges
    duration_s: NonNegativeRange

    def _check_fields(self) -> None:
        super()._check_fields()
        # In other modes it would not be called at each step, and a push would never end.
        if self.mode != "interval":
            raise ValueError(
                f"mode={self.mode!r}: expected 'interval', which also says when a push ends"
            )

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Begin a push in the rows of `mask_E`, and go on with or end the other rows' pushes; once per env step."""
        held_E6 = view.buffer("wrench_E6", 6)
        applied_E6 = view.buffer("applied_E6", 6)
        left_E = view.buffer("left_s_E")
        drawn_E6 = draw_by_axis(view, self.wrench_range)
        # At least one env step: a shorter push would be over before physics sees it.
        duration_E = view.uniform(1, *self.duration_s)[:, 0].clamp(min=view.step_dt)
        left_E.copy_(torch.where(mask_E, duration_E, left_E - view.step_dt))
        held_E6.copy_(torch.where(mask_E[:, None], drawn_E6, held_E6))
        # The clock has run out at the env step that is nearest, whatever the subtractions round to.
        is_on_E = left_E > 0.5 * view.step_dt
        wrench_E6 = torch.where(is_on_E[:, None], held_E6, 0.0)
        body = view.resolver.one("body", self.body)
        # Only the change is added: other events may press on the same body.
        view.world.xfrc_applied_EL[:, body].add_(wrench_E6 - applied_E6)
        applied_E6.copy_(wrench_E6)


@dataclass(frozen=True, kw_only=True)
class Jump(OfEntity, EventTerm):
    """Throw the free root body up: add the velocity sqrt(2 g h) that carries it a drawn height h (m) in free flight."""

    mode: EventMode = "interval"
    height_range: NonNegativeRange

    def __call__(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        body = view.entity(self.entity)
        height_E = view.uniform(1, *self.height_range)[:, 0]
        # Each world may have gravity of its own.
        gravity_E = torch.linalg.vector_norm(view.world.gravity_EL, dim=-1)
        up_E = torch.sqrt(2.0 * gravity_E * height_E)
        lin_vel_E3 = body.root_lin_vel_w_EL.clone()
        # World z is up, whatever the direction of gravity.
        lin_vel_E3[:, 2] += up_E
        body.write_root_velocity(mask_E, lin_vel_E3, body.root_ang_vel_w_EL)
