"""Commands that ask for a pose: of the root, of joints, of a body or site."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ksim_rl.checks import check_choice, check_pair
from ksim_rl.envs.term import CommandTerm
from ksim_rl.envs.view import EnvView
from ksim_rl.mdp import se3_ranges
from ksim_rl.mdp.commands.target_pose import FRAMES, target_pose_w
from ksim_rl.mdp.root_height import root_height
from ksim_rl.scene import quaternion
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.rendering.visualizer import DebugVisualizer, Rgba

_WANTED: Rgba = (0.2, 0.6, 0.2, 0.5)


@dataclass(frozen=True, kw_only=True)
class BaseHeightCommand(CommandTerm):
    """A height of the root body's frame above the ground, m, [E, 1], drawn uniformly.

    Attributes:
        height: m.
        entity: the robot that it is for; "" is the first one.
    """

    height: tuple[float, float]
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair("height", self.height)

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """What a curriculum may change."""
        return {"height": self.height}

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw heights for the rows of `mask_E`."""
        drawn_E1 = view.uniform(1, *self.shared_ranges(view).unbind(0))
        held_E1 = self._held(view)
        held_E1.copy_(torch.where(mask_E[:, None], drawn_E1, held_E1))

    def __call__(self, view: EnvView) -> Tensor:
        """Return the command, float32 [E, 1]."""
        return self._held(view).clone()

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw a ball at the commanded height, in line with the root."""
        x, y, z = view.entity(self.entity).root_pos_EL[env_index].tolist()
        rise = float(self._held(view)[env_index, 0] - root_height(view, self.entity)[env_index])
        visualizer.sphere((x, y, z + rise), radius=0.03, rgba=_WANTED)

    def _held(self, view: EnvView) -> Tensor:
        return view.buffer("height_E1", 1)


@dataclass(frozen=True, kw_only=True)
class JointPositionCommand(CommandTerm):
    """Positions of joints, rad or m, [E, N]: the default pose plus a uniform offset, kept inside the soft limits.

    Attributes:
        joints: names or patterns; one column each, in this order.
        offset: rad or m.
    """

    joints: Patterns
    offset: tuple[float, float]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_pair("offset", self.offset)

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """What a curriculum may change."""
        return {"offset": self.offset}

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw positions for the rows of `mask_E`."""
        joints = view.joints(self.joints)
        default_EN, limits_N2 = joints.default_pos_EL, joints.soft_limits_L2
        offset_EN = view.uniform(default_EN.shape[1], *self.shared_ranges(view).unbind(0))
        drawn_EN = torch.clamp(default_EN + offset_EN, limits_N2[:, 0], limits_N2[:, 1])
        held_EN = self._held(view)
        held_EN.copy_(torch.where(mask_E[:, None], drawn_EN, held_EN))

    def __call__(self, view: EnvView) -> Tensor:
        """Return the command, float32 [E, N]."""
        return self._held(view).clone()

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the robot as it should be."""
        qpos = view.world.qpos_EL[env_index].cpu().numpy().copy()
        targets = self._held(view)[env_index].tolist()
        for name, target in zip(view.joints(self.joints).names, targets, strict=True):
            qpos[view.world.mj_model.joint(name).qposadr[0]] = target
        visualizer.ghost(qpos, rgba=_WANTED)

    def _held(self, view: EnvView) -> Tensor:
        return view.buffer("pos_EN", len(view.joints(self.joints)))


@dataclass(frozen=True, kw_only=True)
class CartesianCommand(CommandTerm):
    """Where a body or site should be: a position, m, [E, 3], and if asked its orientation (w, x, y, z) too, [E, 7].

    Attributes:
        position: ranges by axis x, y, z, m; an axis that is left out is 0.
        orientation: ranges by axis roll, pitch, yaw, rad; None commands no orientation. The rotation is
            Rz(yaw) Ry(pitch) Rx(roll).
        frame: "root": drawn and given in the frame of the root body, with which the target moves; "world".
        entity: whose root that is; "" is the first robot.
    """

    position: Mapping[str, tuple[float, float]]
    orientation: Mapping[str, tuple[float, float]] | None = None
    frame: Literal["root", "world"] = "root"
    entity: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("frame", self.frame, FRAMES)
        se3_ranges.check_ranges("position", self.position, se3_ranges.AXES[:3])
        if self.orientation is not None:
            se3_ranges.check_ranges("orientation", self.orientation, se3_ranges.AXES[3:])

    @property
    def ranges(self) -> Mapping[str, tuple[float, float]]:
        """What a curriculum may change: all axes that the command has, x, y, z, roll, pitch, yaw."""
        given = {**self.position, **(self.orientation or {})}
        axes = se3_ranges.AXES[: 3 if self.orientation is None else 6]
        return {axis: given.get(axis, (0.0, 0.0)) for axis in axes}

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Draw targets for the rows of `mask_E`."""
        drawn_EK = view.uniform(len(self.ranges), *self.shared_ranges(view).unbind(0))
        if self.orientation is not None:
            quat_E4 = quaternion.from_euler_xyz(*drawn_EK[:, 3:].unbind(-1))
            drawn_EK = torch.cat((drawn_EK[:, :3], quat_E4), dim=-1)
        held_EK = self._held(view)
        held_EK.copy_(torch.where(mask_E[:, None], drawn_EK, held_EK))

    def __call__(self, view: EnvView) -> Tensor:
        """Return the command in `frame`, float32 [E, 3] or [E, 7]."""
        return self._held(view).clone()

    def draw_debug(self, view: EnvView, visualizer: DebugVisualizer, env_index: int) -> None:
        """Draw the target: a ball and, if an orientation is commanded, its axes."""
        pos_E3, quat_E4 = target_pose_w(view, self._held(view), frame=self.frame, entity=self.entity)
        origin = pos_E3[env_index].cpu().numpy()
        visualizer.sphere(origin, radius=0.03, rgba=_WANTED)
        if quat_E4 is not None:
            visualizer.frame(origin, _axes(quat_E4[env_index]))

    def _held(self, view: EnvView) -> Tensor:
        return view.buffer("target_EK", 3 if self.orientation is None else 7)


@dataclass(frozen=True, kw_only=True)
class StartPoseCommand(CommandTerm):
    """The root's pose at the start of the episode, world frame: position, m, and quaternion (w, x, y, z), [E, 7].

    With a resampling range, the pose at the last resampling. For tasks that stay in place, or return to it.

    Attributes:
        entity: the robot or object; "" is the first robot.
    """

    resampling_time_range_s: tuple[float, float] | None = None
    entity: str = ""

    def resample(self, view: EnvView, mask_E: Tensor) -> None:
        """Mark the rows of `mask_E`: their pose is read once it is up to date."""
        self._is_due(view).logical_or_(mask_E)

    def __call__(self, view: EnvView) -> Tensor:
        """Return the command, float32 [E, 7]."""
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
