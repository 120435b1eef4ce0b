"""Writes motions as files that `view.motion` reads, with velocities made from the positions."""

import io
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.files.writing import write_whole

Array = np.ndarray


def velocities(
    mj_model: mujoco.MjModel, qpos_FL: Float[Array, "F L"], fps: float
) -> Float[Array, "F M"]:
    """Return qvel by central differences, one-sided at the ends; angular velocities come from quaternions."""
    last = len(qpos_FL) - 1
    qvel_FM = np.zeros((len(qpos_FL), mj_model.nv))
    # Over two frames in the middle, over one at both ends.
    for frame in range(len(qpos_FL)):
        before = max(frame - 1, 0)
        after = min(frame + 1, last)
        seconds = (after - before) / fps
        mujoco.mj_differentiatePos(
            mj_model, qvel_FM[frame], seconds, qpos_FL[before], qpos_FL[after]
        )
    # The angular velocity is of the body frame at the first of the two frames; turn it to the frame's own.
    return _turned_to_own_frame(mj_model, qpos_FL, qvel_FM)


def _turned_to_own_frame(mj_model: mujoco.MjModel, qpos_FL: Array, qvel_FM: Array) -> Array:
    # Only free joints have angular velocities in a moving frame here.
    free = np.flatnonzero(mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    for joint in free:
        quat = int(mj_model.jnt_qposadr[joint]) + 3
        turn = int(mj_model.jnt_dofadr[joint]) + 3
        for frame in range(len(qpos_FL)):
            # The frame that mj_differentiatePos took as the first.
            before_4 = qpos_FL[max(frame - 1, 0), quat : quat + 4]
            own_4 = qpos_FL[frame, quat : quat + 4]
            world_3 = np.empty(3)
            back_4 = np.empty(4)
            # From that frame into the world, and from the world into the frame's own.
            mujoco.mju_rotVecQuat(world_3, qvel_FM[frame, turn : turn + 3].copy(), before_4)
            mujoco.mju_negQuat(back_4, own_4)
            mujoco.mju_rotVecQuat(qvel_FM[frame, turn : turn + 3], world_3, back_4)
    return qvel_FM


def motion_bytes(mj_model: mujoco.MjModel, qpos_FL: Float[Array, "F L"], fps: float) -> bytes:
    # Without times of files in it, NumPy's archive is the same for the same arrays.
    """Return an .npz archive of a motion of the model; the same bytes for the same motion."""
    data = io.BytesIO()
    np.savez_compressed(
        data,
        fps=np.float64(fps),
        qpos=qpos_FL.astype(np.float32),
        qvel=velocities(mj_model, qpos_FL, fps).astype(np.float32),
        joint_names=np.array([mj_model.joint(i).name for i in range(mj_model.njnt)]),
    )
    return data.getvalue()


def write_motion(
    path: Path, mj_model: mujoco.MjModel, qpos_FL: Float[Array, "F L"], fps: float
) -> None:
    """Write a motion of the model, whose scene may hold other things without joints, at `fps` frames per second.

    A ValueError refuses fewer than two frames, which are no motion.
    """
    if len(qpos_FL) < 2:
        raise ValueError(
            f"{path}: a motion of {len(qpos_FL)} frames at {fps:g} per second: expected two or more: raise the rate, "
            "or give a longer recording"
        )
    write_whole(path, motion_bytes(mj_model, qpos_FL, fps))
