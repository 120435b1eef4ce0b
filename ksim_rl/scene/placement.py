"""This module says where an entity of a scene stands, and moves its spec there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.checked import Checked
from ksim_rl.physics import load_model


@dataclass(frozen=True, kw_only=True)
class Placement(Checked):
    """A rigid transform from an entity's own world frame into the scene's.

    Attributes:
        pos: m.
        quat: (w, x, y, z), a unit quaternion.
    """

    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not math.isclose(math.hypot(*self.quat), 1.0, abs_tol=1e-3):
            raise ValueError(f"quat={self.quat!r}: expected a unit quaternion (w, x, y, z)")

    def move(self, spec: mujoco.MjSpec) -> None:
        """Move all that stands in the spec's world, and the free joints of its keyframes."""
        model = load_model(spec)
        world = spec.worldbody
        loose = [
            element
            for kind in (world.frames, world.bodies, world.geoms, world.sites, world.cameras, world.lights)
            for element in kind
            if element.frame is None
        ]
        frame = world.add_frame(pos=self.pos, quat=self.quat)
        for element in loose:
            element.set_frame(frame)
        for key in spec.keys:
            qpos = np.array(key.qpos)
            for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
                self._move_pose(qpos[model.jnt_qposadr[joint] :][:7])
            key.qpos = qpos

    def _move_pose(self, pose: np.ndarray) -> None:
        """Transform position and orientation in place, [7]."""
        pos, quat = np.zeros(3), np.zeros(4)
        mujoco.mju_mulPose(
            pos, quat, np.array(self.pos), np.array(self.quat), pose[:3].copy(), pose[3:].copy()
        )
        pose[:3], pose[3:] = pos, quat
