"""These commands ask for a pose: of the root, of joints, of a body or site."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegativeRange, Range
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp import se3_ranges
from ksim_rl.mdp.fields import InFrame, OfEntity
from ksim_rl.mdp.quantities import root_height
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, Rgba


@dataclass(frozen=True, kw_only=True)
class OfTarget(InFrame):
    """A term of a body or site and of the position that a command asks it to take.

    Attributes:
        command: a position, with an orientation or not, such as `CartesianCommand` or `StartPoseCommand`, in `frame`.
        body, site: what should be there; name one of the two.
    """

    command: str
    body: str | None = None
    site: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.body is None) == (self.site is None):
            raise ValueError(f"body={self.body!r}, site={self.site!r}: name exactly one of the two")

    def offset(self, view: EnvView) -> Float[Tensor, "E 3"]:
        """Return the commanded position minus where the body or site is, world frame, m; position stage."""
        target_E3, _ = target_pose_w(view, view.command(self.command), frame=self.frame, entity=self.entity)
        return target_E3 - point_pos_w(view, body=self.body, site=self.site)

    def distance(self, view: EnvView) -> Float[Tensor, " E"]:
        """Return how far the body or site is from the commanded position, m; position stage."""
        return torch.linalg.vector_norm(self.offset(view), dim=-1)


def target_pose_w(
    view: EnvView, target_EK: Float[Tensor, "E K"], *, frame: Literal["root", "world"], entity: str = ""
) -> tuple[Float[Tensor, "E 3"], Float[Tensor, "E 4"] | None]:
    """Return a target's position in the world frame, m, and its quaternion there if the target has one.

    Args:
        target_EK: position [E, 3], or position and quaternion (w, x, y, z) [E, 7], in `frame`.
        frame, entity: see `InFrame`.
    """
    pos_E3, quat_E4 = target_EK[:, :3], target_EK[:, 3:] if target_EK.shape[1] == 7 else None
    if frame == "world":
        return pos_E3, quat_E4
    root = view.entity(entity)
    pos_E3 = root.root_pos_EL + quaternion.rotate(root.root_quat_EL, pos_E3)
    return pos_E3, None if quat_E4 is None else quaternion.multiply(root.root_quat_EL, quat_E4)


def point_pos_w(view: EnvView, *, body: str | None, site: str | None) -> Float[Tensor, "E 3"]:
    """Return the position of the one body or site that is named, world frame, m; position stage.

    Raises:
        ValueError: if several match the name.
    """
    if site is not None:
        return view.site(site).pos_EL
    assert body is not None
    return view.body(body).pos_EL


_WANTED: Rgba = (0.2, 0.6, 0.2, 0.5)


@dataclass(frozen=True, kw_only=True)
class HeldCommand(CommandTerm):
    """A command that stays as it was drawn until it is drawn again."""

    @abstractmethod
    def held(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return the buffer of what was drawn."""

    @abstractmethod
    def draw(self, view: EnvView) -> Float[Tensor, "E K"]:
        """Return new values for all rows."""

    def resample(self, view: EnvView, mask_E: Bool[Tensor, " E"]) -> None:
        """Draw values for the rows of `mask_E`."""
        drawn_EK, held_EK = self.draw(view), self.held(view)
        held_EK.copy_(torch.where(mask_E[:, None], drawn_EK, held_EK))

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        return self.held(view).clone()


@dataclass(frozen=True, kw_only=True)
class BaseHeightCommand(OfEntity, HeldCommand):
    """A height of the root body's frame above the ground, m, [E, 1], drawn uniformly.

    Attributes:
        height: m.
    """

    height: Range

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        return {"height": self.height}

    def held(self, view: EnvView) -> Float[Tensor, "E 1"]:
        return view.buffer("height_E1", 1)

    def draw(self, view: EnvView) -> Float[Tensor, "E 1"]:
        return view.uniform(1, *self.shared_ranges(view).unbind(0))

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw a ball at the commanded height, in line with the root."""
        x, y, z = view.entity(self.entity).root_pos_EL[env_index].tolist()
        rise = float(self.held(view)[env_index, 0] - root_height(view, self.entity)[env_index])
        visualizer.sphere((x, y, z + rise), radius=0.03, rgba=_WANTED)


@dataclass(frozen=True, kw_only=True)
class JointPositionCommand(HeldCommand):
    """Positions of joints, rad or m, [E, N]: the default pose plus a uniform offset, kept inside the soft limits.

    Attributes:
        joints: names or patterns; one column each, in this order.
        offset: rad or m.
    """

    joints: Patterns
    offset: Range

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        return {"offset": self.offset}

    def held(self, view: EnvView) -> Float[Tensor, "E N"]:
        return view.buffer("pos_EN", len(view.joints(self.joints)))

    def draw(self, view: EnvView) -> Float[Tensor, "E N"]:
        joints = view.joints(self.joints)
        default_EN, limits_N2 = joints.default_pos_EL, joints.soft_limits_L2
        offset_EN = view.uniform(default_EN.shape[1], *self.shared_ranges(view).unbind(0))
        return torch.clamp(default_EN + offset_EN, limits_N2[:, 0], limits_N2[:, 1])

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the robot as it should be."""
        qpos = view.world.qpos_EL[env_index].cpu().numpy().copy()
        targets = self.held(view)[env_index].tolist()
        for name, target in zip(view.joints(self.joints).names, targets, strict=True):
            qpos[view.world.mj_model.joint(name).qposadr[0]] = target
        visualizer.ghost(qpos, rgba=_WANTED)


@dataclass(frozen=True, kw_only=True)
class CartesianCommand(InFrame, HeldCommand):
    """Where a body or site should be: a position, m, [E, 3], and if asked its orientation (w, x, y, z) too, [E, 7].

    Attributes:
        position: ranges by axis x, y, z, m; an axis that is left out is 0.
        orientation: ranges by axis roll, pitch, yaw, rad; None commands no orientation. The rotation is
            Rz(yaw) Ry(pitch) Rx(roll).
    """

    position: Mapping[str, tuple[float, float]]
    orientation: Mapping[str, tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        se3_ranges.check_ranges("position", self.position, se3_ranges.AXES[:3])
        if self.orientation is not None:
            se3_ranges.check_ranges("orientation", self.orientation, se3_ranges.AXES[3:])

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """What a curriculum may change: all axes that the command has, x, y, z, roll, pitch, yaw."""
        given = {**self.position, **(self.orientation or {})}
        axes = se3_ranges.AXES[: 3 if self.orientation is None else 6]
        return {axis: given.get(axis, (0.0, 0.0)) for axis in axes}

    def held(self, view: EnvView) -> Float[Tensor, "E K"]:
        return view.buffer("target_EK", 3 if self.orientation is None else 7)

    def draw(self, view: EnvView) -> Float[Tensor, "E K"]:
        drawn_EK = view.uniform(len(self.ranges), *self.shared_ranges(view).unbind(0))
        if self.orientation is None:
            return drawn_EK
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
        self._is_due(view).logical_or_(mask_E)

    def __call__(self, view: EnvView) -> Float[Tensor, "E K"]:
        robot, is_due_E, held_E7 = view.entity(self.entity), self._is_due(view), view.buffer("pose_E7", 7)
        pose_E7 = torch.cat((robot.root_pos_EL, robot.root_quat_EL), dim=-1)
        held_E7.copy_(torch.where(is_due_E[:, None], pose_E7, held_E7))
        is_due_E.zero_()
        return held_E7.clone()

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the pose's axes."""
        pose_7 = view.buffer("pose_E7", 7)[env_index]
        visualizer.frame(pose_7[:3].cpu().numpy(), _axes(pose_7[3:]), scale=0.2)

    def _is_due(self, view: EnvView) -> Tensor:
        return view.buffer("is_due_E", dtype=torch.bool)


def _axes(quat_4: Tensor) -> np.ndarray:
    """Return the rotation matrix [3, 3] of a quaternion [4]."""
    return quaternion.rotate(quat_4.expand(3, 4), torch.eye(3, device=quat_4.device)).T.cpu().numpy()
