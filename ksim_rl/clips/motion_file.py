"""This module writes motions as files that `view.motion` reads, with velocities made from the positions."""

import io
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.clips.dynamics import velocities


def motion_bytes(mj_model: mujoco.MjModel, qpos_FL: Float[np.ndarray, "F L"], fps: float) -> bytes:
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


def write_motion(path: Path, mj_model: mujoco.MjModel, qpos_FL: Float[np.ndarray, "F L"], fps: float) -> None:
    """Write a motion of the model, whose scene may hold other things without joints, at `fps` frames per second."""
    path.write_bytes(motion_bytes(mj_model, qpos_FL, fps))
