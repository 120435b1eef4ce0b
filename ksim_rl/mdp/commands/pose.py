"""These commands ask for a pose: of the root, of joints, of a body or site."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ksim_rl.checked import NonNegativeRange, Range
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp import se3_ranges
from ksim_rl.mdp.commands.target_pose import target_pose_w
from ksim_rl.mdp.fields import InFrame, OfEntity
from ksim_rl.mdp.quantities import root_height
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, Rgba

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
