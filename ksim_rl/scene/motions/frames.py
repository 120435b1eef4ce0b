"""Goes through the frames of a motion of a robot, with all its parts where the C engine has them."""

from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Float


def in_each_frame(
    mj_model: mujoco.MjModel, qpos_FL: Float[np.ndarray, "F L"]
) -> Iterator[mujoco.MjData]:
    """Yield the poses of bodies, geoms and sites in each frame: one object for all, so copy what is to stay."""
    data = mujoco.MjData(mj_model)
    for qpos in qpos_FL:
        data.qpos[:] = qpos
        # Kinematics alone: no forces are needed for poses.
        mujoco.mj_kinematics(mj_model, data)
        yield data
