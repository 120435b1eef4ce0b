"""Tells which joints of a stranger's robot have no motor."""

import mujoco
import numpy as np

from ksim_rl.scene.names import TO_JOINTS, scalar_joint_ids


def passive_joints(mj_model: mujoco.MjModel) -> list[int]:
    """Return the hinges and slides without a motor: springs, rods of closed chains, fingers that follow others.

    A model with actuators leaves those to themselves that none of its actuators moves, directly or by a fixed tendon.
    In one without any, as CAD exports are, joints with a spring have no motor. Where sites or spatial tendons pull,
    which joints these move is not told by the model, and each joint counts as driven.
    """
    joints = scalar_joint_ids(mj_model)
    # Adhesion moves nothing.
    moving = np.flatnonzero(mj_model.actuator_trntype != mujoco.mjtTrn.mjTRN_BODY)
    if not moving.size:
        # Without actuators, as in files from CAD, only a spring tells a joint that is not meant to be driven.
        return [joint for joint in joints if mj_model.jnt_stiffness[joint] > 0.0]
    driven: set[int] = set()
    for actuator in moving:
        moved = _moved_by(mj_model, int(actuator))
        if moved is None:
            # It is unknown which joints move: all count as driven.
            return []
        driven.update(moved)
    return [joint for joint in joints if joint not in driven]


def _moved_by(mj_model: mujoco.MjModel, actuator: int) -> list[int] | None:
    """Return the joints that an actuator moves; None where the model does not tell."""
    kind = int(mj_model.actuator_trntype[actuator])
    target = int(mj_model.actuator_trnid[actuator, 0])
    if kind in TO_JOINTS:
        return [target]
    if kind != mujoco.mjtTrn.mjTRN_TENDON:
        return None
    first = int(mj_model.tendon_adr[target])
    count = int(mj_model.tendon_num[target])
    # A spatial tendon pulls on all that it passes.
    if (mj_model.wrap_type[first : first + count] != mujoco.mjtWrap.mjWRAP_JOINT).any():
        return None
    return mj_model.wrap_objid[first : first + count].tolist()
