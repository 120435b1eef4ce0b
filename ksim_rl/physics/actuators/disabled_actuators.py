"""Switches off the actuators whose group the option `actuatorgroupdisable` disables, as the C engine does.

A disabled actuator makes no force, adds nothing to the derivatives of an implicit integrator, and its activation keeps
still; its length, velocity and `act_dot` are computed as ever. MuJoCo Warp never reads the option.
"""

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

# No gain or bias of MuJoCo's has this type: MuJoCo Warp's kernels find none, and ours look for it.
SWITCHED_OFF = -1
# Groups beyond these have no bit in the option.
MOST_GROUPS = 31


def switch_off(mj_model: mujoco.MjModel, warp_model: mjw.Model) -> None:
    """Switch off the disabled actuators of a Warp model, in place. Call it before anything copies the model."""
    disabled = _is_disabled(mj_model)
    if not disabled.any():
        return
    for name in ("actuator_gaintype", "actuator_biastype"):
        types = getattr(warp_model, name).numpy()
        types[disabled] = SWITCHED_OFF
        setattr(warp_model, name, wp.array(types, dtype=int))


def still_activations(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the columns of `act` that no step may change: of disabled actuators, or of all without actuation."""
    if mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        # MuJoCo Warp would put them into their range.
        return np.arange(mj_model.na, dtype=np.int32)
    columns: list[int] = []
    # An actuator may have several activations, or none.
    for actuator in np.flatnonzero(_is_disabled(mj_model)):
        first = mj_model.actuator_actadr[actuator]
        columns += range(first, first + mj_model.actuator_actnum[actuator])
    return np.array(columns, dtype=np.int32)


def _is_disabled(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return which actuators the option disables, bool [nactuator]."""
    group = mj_model.actuator_group
    # A shift by 31 or more, or by a negative number, would be undefined.
    has_bit = (group >= 0) & (group < MOST_GROUPS)
    bits = np.left_shift(1, np.where(has_bit, group, 0))
    return has_bit & ((mj_model.opt.disableactuator & bits) != 0)
