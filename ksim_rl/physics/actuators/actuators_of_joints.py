"""Lets actuators add armature and damping to joints and tendons where only some worlds give them any.

MuJoCo notes for each joint and tendon which actuator adds to it, by the values that the model was compiled with. Where
none had any, a world's own `actuator_armature` or `actuator_damping` would add nothing.
"""

from collections.abc import Collection

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

ADDED_FIELDS = frozenset(("actuator_armature", "actuator_damping", "actuator_dampingpoly"))
# MuJoCo's marks where no actuator adds, and where several do.
NONE = -1
SEVERAL = -2
_OF_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_OF_TENDONS = (mujoco.mjtTrn.mjTRN_TENDON,)


def let_actuators_add(
    mj_model: mujoco.MjModel, warp_model: mjw.Model, per_world_fields: Collection[str]
) -> None:
    """Note every actuator that drives a joint or tendon as one that adds to it, in place, if worlds may differ in that.

    An actuator without armature and damping adds zeros.
    """
    if not ADDED_FIELDS & set(per_world_fields):
        return
    warp_model.jnt_actuatorid = _noted(mj_model, _OF_JOINTS, mj_model.njnt)
    warp_model.tendon_actuatorid = _noted(mj_model, _OF_TENDONS, mj_model.ntendon)


def _noted(mj_model: mujoco.MjModel, transmissions: Collection[int], count: int) -> wp.array:
    noted = np.full(count, NONE, dtype=np.int32)
    for actuator in np.flatnonzero(np.isin(mj_model.actuator_trntype, list(transmissions))):
        driven = mj_model.actuator_trnid[actuator, 0]
        noted[driven] = actuator if noted[driven] == NONE else SEVERAL
    return wp.array(noted, dtype=int)
