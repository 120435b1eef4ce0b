"""Commands that ask for poses of a root, joints, a body or a site."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegativeRange, Range
from ksim_rl.envs.term import CommandRanges, CommandTerm
from ksim_rl.envs.view import EnvView
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
        target_E3, _ = target_pose_w(
            view, view.command(self.command), frame=self.frame, entity=self.entity
        )
        if self.body is not None:
            point = view.body(self.body)
        else:
            point = view.site(str(self.site))
        return target_E3 - point.pos_EL

    def distance(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return how far the body or site is from the commanded position, m; position stage."""
        return torch.linalg.vector_norm(self.offset(view), dim=-1)


def target_pose_w(
    view: EnvView,
    target_EK: Float[Tensor, "E K"],
    *,
    frame: Literal["root", "world"],
    entity: str = "",
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

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        return list(ranges.values())

    def held(self, view: EnvView) -> Float[Tensor, "E 1"]:
        return view.buffer("height_E1", 1)

    def draw(self, view: EnvView) -> Float[Tensor, "E 1"]:
        # Read at each draw: a curriculum may have moved the ranges.
        low_1, high_1 = self.shared_ranges(view).unbind(0)
        return view.uniform(1, low_1, high_1)

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

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        joints = view.joints(self.joints)
        limits_N2 = joints.soft_limits_L2
        # The model's own pose: events may draw others around it.
        default_N = view.default_qpos_L[joints.qpos]
        ends = []
        for end in ranges["offset"]:
            within_N = torch.clamp(default_N + end, limits_N2[:, 0], limits_N2[:, 1])
            ends.append(within_N.tolist())
        return list(zip(*ends, strict=True))

    def held(self, view: EnvView) -> Float[Tensor, "E N"]:
        return view.buffer("pos_EN", len(view.joints(self.joints)))

    def draw(self, view: EnvView) -> Float[Tensor, "E N"]:
        joints = view.joints(self.joints)
        default_EN = joints.default_pos_EL
        limits_N2 = joints.soft_limits_L2
        low_1, high_1 = self.shared_ranges(view).unbind(0)
        offset_EN = view.uniform(default_EN.shape[1], low_1, high_1)
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
        given: dict[str, Range] = {}
        for part in (self.position, self.orientation or {}):
            for axis, pair in part.items():
                given[axis] = pair
        # An orientation is drawn as three angles, but held as a quaternion of four numbers.
        axes = _AXES[: 3 if self.orientation is None else 6]
        return {axis: given.get(axis, (0.0, 0.0)) for axis in axes}

    def bounds(self, view: EnvView, ranges: CommandRanges) -> Sequence[tuple[float, float]]:
        position = list(ranges.values())[:3]
        if self.orientation is None:
            return position
        # The four numbers of a quaternion.
        return [*position, *[(-1.0, 1.0)] * 4]

    def held(self, view: EnvView) -> Float[Tensor, "E K"]:
        return view.buffer("target_EK", 3 if self.orientation is None else 7)

    def draw(self, view: EnvView) -> Float[Tensor, "E K"]:
        low_K, high_K = self.shared_ranges(view).unbind(0)
        drawn_EK = view.uniform(len(self.ranges), low_K, high_K)
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
    unit_33 = torch.eye(3, device=quat_4.device)
    rotated_33 = quaternion.rotate(quat_4.expand(3, 4), unit_33)
    # Rotated unit vectors are the columns of the matrix, hence the transpose.
    return rotated_33.T.cpu().numpy()
