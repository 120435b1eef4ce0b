"""Mirrors motions of a robot left and right, in the plane y = 0 of the world."""

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.scene.names import scalar_joint_ids
from ksim_rl.transforms.mirror.robot_mirror import mirror_joints

Array = np.ndarray


def mirrored(mj_model: mujoco.MjModel, qpos_FL: Float[Array, "F L"]) -> Float[Array, "F L"]:
    """Return the mirror image of a motion of a model with a free root, whose two sides are alike.

    A ValueError if a joint has no counterpart on the other side.
    """
    image_FL = qpos_FL.copy()
    # The root: y changes its sign, and so do the turns about x and z.
    image_FL[:, 1] = -qpos_FL[:, 1]
    image_FL[:, [4, 6]] = -qpos_FL[:, [4, 6]]
    places = mj_model.jnt_qposadr[scalar_joint_ids(mj_model)]
    image = mirror_joints(mj_model)
    image_FL[:, places] = qpos_FL[:, places[list(image.source)]] * np.array(image.signs)
    return image_FL
