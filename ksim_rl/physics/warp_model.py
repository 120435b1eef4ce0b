"""Makes MuJoCo Warp's model of a MuJoCo model, mended so that it computes as MuJoCo's C engine does."""

import copy
from collections.abc import Sequence

import mujoco
import mujoco_warp as mjw

from ksim_rl.physics import upstream
from ksim_rl.physics.actuators.actuators_of_joints import let_actuators_add
from ksim_rl.physics.actuators.disabled_actuators import switch_off
from ksim_rl.physics.constants.least_weights import raising_of_weights
from ksim_rl.physics.contacts import follow_the_c_engine
from ksim_rl.physics.field_effects import as_if_drawn
from ksim_rl.physics.model_checks import warn_of_weightless, warp_model_of
from ksim_rl.physics.sim_cfg import SimCfg


def stored_form(mj_model: mujoco.MjModel, *, is_sparse: bool) -> mujoco.MjModel:
    """Return a copy of a model with the options that MuJoCo Warp's arrays are made for; `is_sparse` is of the rows."""
    # Our solver takes sparse rows only, and `mj_model` keeps the user's settings.
    stored_mj_model = copy.copy(mj_model)
    if is_sparse:
        stored_mj_model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    if not upstream.may_sleep(mj_model.opt):
        # MuJoCo Warp's solver looks at this flag alone, and writes to arrays that it has not made without islands.
        stored_mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return stored_mj_model


def make_warp_model(
    mj_model: mujoco.MjModel,
    stored_mj_model: mujoco.MjModel,
    sim: SimCfg,
    *,
    expanded: Sequence[str],
    num_envs: int,
) -> mjw.Model:
    """Return MuJoCo Warp's model of the `stored_form`, in which each world has its own values of the expanded fields.

    Called in a Warp scope.
    """
    warp_model = warp_model_of(stored_mj_model, dict.fromkeys(expanded, num_envs))
    warn_of_weightless(mj_model)
    raising_of_weights(mj_model, warp_model)()
    with as_if_drawn(warp_model, expanded):
        follow_the_c_engine(warp_model)
    switch_off(mj_model, warp_model)
    let_actuators_add(mj_model, warp_model, expanded)
    # The overflow report has it, once per rollout.
    warp_model.opt.warn_overflow = 0
    if sim.tolerance is not None:
        warp_model.opt.tolerance.fill_(sim.tolerance)
    return warp_model
