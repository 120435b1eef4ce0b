"""This module chooses which worlds have their smooth dynamics computed by one kernel, and launches it."""

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.smooth.kernel import CUDA_THREADS, Problem, Shape, smooth_kernel
from ksim_rl.physics.structs import filled

# The shared memory that a block has without asking for more, in floats.
SHARED_FLOATS = 48 * 1024 // 4
LANES = (8, 16, 32)
FORCE_CALLBACKS = ("passive", "control", "act_dyn", "act_gain", "act_bias")
HINGES = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
AFFINE = {
    "actuator_trntype": (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT),
    "actuator_dyntype": (
        *(mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_INTEGRATOR),
        *(mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT),
    ),
    "actuator_gaintype": (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE),
    "actuator_biastype": (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE),
}


def unsuited(warp_model: mjw.Model) -> str | None:
    """Return why the kernel cannot compute this model's smooth dynamics, or None where it can."""
    m = warp_model
    reasons = {
        "there are flexes": m.nflex > 0,
        "there are tendons": m.ntendon > 0,
        "there are no degrees of freedom": m.nv == 0,
        "bodies compensate gravity": len(m.body_gravcomp) > 1 or bool(m.body_gravcomp.numpy().any()),
        "there is a fluid": m.has_fluid,
        "contacts adhere": bool(m.flg_adhesion),
        "joints yield": bool(m.nplastic),
        "an actuator is delayed": m.nhistory > 0,
        "an actuator is not affine or drives no hinge or slide": not _has_affine_actuators(m),
        "its bodies do not fit shared memory": _lanes(_shape(m)) is None,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def calls_back(warp_model: mjw.Model) -> bool:
    """Whether a callback of MuJoCo Warp has a part in the forces."""
    return any(getattr(warp_model.callback, name) for name in FORCE_CALLBACKS)


def one_kernel_dynamics_unavailable(
    warp_model: mjw.Model, sim: SimCfg, *, solver_unavailable: str | None
) -> str | None:
    """Return why MuJoCo Warp's own kernels compute a model's smooth dynamics, or None where one kernel does."""
    if not sim.one_kernel_dynamics:
        return "sim.one_kernel_dynamics is False"
    if solver_unavailable is not None:
        return "the constraints are not solved by one kernel"
    return unsuited(warp_model)


def smooth_dynamics(
    warp_model: mjw.Model, warp_data_E: mjw.Data, *, lanes: int | None = None
) -> Callable[[bool], None]:
    """Return what launches the smooth dynamics of a model that is not `unsuited`, with arrays in their final place.

    Called with True, it computes all that MuJoCo Warp's `fwd_position`, `fwd_velocity`, `fwd_actuation` and
    `fwd_acceleration` do, but for cameras, lights, contacts, constraint rows and `qacc_smooth`; with False, of these
    what positions and velocities alone decide. `lanes` is how many threads share a world on CUDA; None takes the
    fewest that fit.
    """
    m, d = warp_model, warp_data_E
    shape, device = _shape(m), d.qpos.device
    threads = CUDA_THREADS if device.is_cuda else 1
    lanes = (lanes or _lanes(shape) or CUDA_THREADS) if device.is_cuda else 1
    driven = m.jnt_dofadr.numpy()[m.actuator_trnid.numpy()[:, 0]]
    own = {
        "moving_geoms": wp.array(_moving_geoms(m), dtype=int, device=device),
        "first_driver": wp.array(np.searchsorted(np.sort(driven), range(m.nv + 1)), dtype=int, device=device),
        "drivers": wp.array(np.argsort(driven, kind="stable"), dtype=int, device=device),
    }
    problem = filled(Problem, own, m, m.opt, d)
    kernel = smooth_kernel(shape, lanes, threads)

    def launch(forces_too: bool) -> None:
        wp.launch(kernel, dim=(d.nworld, lanes), inputs=[problem, forces_too], block_dim=threads)

    return launch


def _shape(warp_model: mjw.Model) -> Shape:
    m = warp_model
    flags, bits = int(m.opt.disableflags), mjw.DisableBit
    return Shape(
        parents=tuple(m.body_parentid.numpy().tolist()),
        num_joints=m.njnt,
        num_dofs=m.nv,
        num_chains=m.nbranch,
        num_moving_geoms=len(_moving_geoms(m)),
        num_sites=m.nsite,
        num_actuators=m.nactuator,
        has_mocap=bool(m.nmocap),
        has_activation=m.na > 0,
        gravity=not flags & bits.GRAVITY,
        springs=not flags & bits.SPRING,
        dampers=not flags & bits.DAMPER,
        clamps_ctrl=not flags & bits.CLAMPCTRL,
        actuators_act=m.nactuator > 0 and not flags & bits.ACTUATION,
    )


def _has_affine_actuators(warp_model: mjw.Model) -> bool:
    m = warp_model
    if not all(np.isin(getattr(m, name).numpy(), kinds).all() for name, kinds in AFFINE.items()):
        return False
    return bool(np.isin(m.jnt_type.numpy()[m.actuator_trnid.numpy()[:, 0]], HINGES).all())


def _lanes(shape: Shape) -> int | None:
    """Return the fewest lanes for which the worlds of a warp fit shared memory together."""
    fitting = (lanes for lanes in LANES if shape.floats(lanes) * (CUDA_THREADS // lanes) <= SHARED_FLOATS)
    return next(fitting, None)


def _moving_geoms(warp_model: mjw.Model) -> np.ndarray:
    """Return the geoms whose place `make_data` does not fix: all but those of the world and what is welded to it."""
    m = warp_model
    body = m.geom_bodyid.numpy()
    moves = m.body_weldid.numpy() != 0
    moves |= m.body_mocapid.numpy()[m.body_rootid.numpy()] != -1
    return np.flatnonzero(moves[body])
