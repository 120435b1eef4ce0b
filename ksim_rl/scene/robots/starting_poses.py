"""Finds the poses from which a stranger's robot may stand: its keyframes, and the model's own pose."""

from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.checks import near
from ksim_rl.scene.names import scalar_joint_ids
from ksim_rl.scene.robots.anatomy import NO_FREE_JOINT, lowest_point, posed
from ksim_rl.scene.robots.upright_root import UPRIGHT, turn_of_root

OWN_POSE = "qpos0"
LEAST_HEIGHT = 0.7
"""Share of the highest centre of mass: a pose that has it lower lies or squats."""


@dataclass(frozen=True, kw_only=True)
class StartingPose:
    """A pose of the model, and how messages call it; `qpos` has each joint inside its range."""

    name: str
    qpos: np.ndarray


def starting_poses(mj_model: mujoco.MjModel, wanted: str | None = None) -> list[StartingPose]:
    """Return the poses to try in the file's order, without those that lie; `wanted` names one, lying or not.

    That is the name of a keyframe, or "qpos0". A ValueError lists those that there are.
    """
    if not (mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
        raise ValueError(NO_FREE_JOINT)
    # The model's own pose is tried last.
    poses = [StartingPose(name=OWN_POSE, qpos=_inside(mj_model, mj_model.qpos0))]
    # Backwards, since each goes to the front.
    for number in reversed(range(mj_model.nkey)):
        name = mj_model.key(number).name or f"keyframe {number}"
        poses.insert(0, StartingPose(name=name, qpos=_inside(mj_model, mj_model.key_qpos[number])))
    if wanted is not None:
        named = [pose for pose in poses if pose.name == wanted]
        if not named:
            raise ValueError(
                f"the model has no pose {wanted!r}: {near(wanted, [pose.name for pose in poses])}"
            )
        # Two poses may have the same name; the first one is meant.
        return named[:1]
    heights = [_height(mj_model, pose.qpos) for pose in poses]
    # The absolute value keeps the bound below the highest pose, whatever its sign.
    least = max(heights) - (1.0 - LEAST_HEIGHT) * abs(max(heights))
    upright = [pose for pose, height in zip(poses, heights, strict=True) if height >= least]
    different: list[StartingPose] = []
    # Keyframes often repeat the own pose; each is tried once.
    for pose in upright:
        if not any(np.allclose(pose.qpos, other.qpos, atol=1e-3) for other in different):
            different.append(pose)
    # Of a root that stands upright in one pose, another pose has it lying or sitting.
    return sorted(different, key=lambda pose: not _root_is_upright(mj_model, pose.qpos))


def _root_is_upright(mj_model: mujoco.MjModel, qpos: np.ndarray) -> bool:
    # The free joint has the lowest joint type, 0.
    first = int(mj_model.jnt_qposadr[mj_model.jnt_type.argmin()])
    return turn_of_root(qpos[first + 3 : first + 7]) == UPRIGHT


def _inside(mj_model: mujoco.MjModel, qpos: np.ndarray) -> np.ndarray:
    """Return a pose with hinges and slides inside their ranges, and balls as the model has them."""
    # A pose outside of a range would be pushed back in the first step.
    inside = qpos.copy()
    for joint in scalar_joint_ids(mj_model):
        if mj_model.jnt_limited[joint]:
            column = mj_model.jnt_qposadr[joint]
            inside[column] = np.clip(inside[column], *mj_model.jnt_range[joint])
    # Balls keep the model's pose: the stance moves hinges and slides only.
    for joint in np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_BALL):
        first = mj_model.jnt_qposadr[joint]
        inside[first : first + 4] = mj_model.qpos0[first : first + 4]
    for joint in np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        first = mj_model.jnt_qposadr[joint]
        # A file's quaternion may have any length.
        mujoco.mju_normalize4(inside[first + 3 : first + 7])
    return inside


def _height(mj_model: mujoco.MjModel, qpos: np.ndarray) -> float:
    """Return m from the lowest point of the robot to its centre of mass."""
    data = posed(mj_model, qpos)
    return float(data.subtree_com[0, 2]) - lowest_point(mj_model, data)
