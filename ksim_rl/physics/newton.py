"""The constraint solver of the substeps, for the models that `suits` names: one kernel instead of some hundred."""

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.newton_kernel import CUDA_LANES, floats_per_world, newton_kernel

# The shared memory that a block has without asking for more, in floats, and how many worlds share it at best.
SHARED_FLOATS = 48 * 1024 // 4
WORLDS_PER_BLOCK = 4
MOST_DOFS = 64
INTEGRATORS = (
    mujoco.mjtIntegrator.mjINT_EULER,
    mujoco.mjtIntegrator.mjINT_IMPLICIT,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
)


def suits(mj_model: mujoco.MjModel, *, njmax: int) -> bool:
    """Whether the kernel can solve this model: Newton from a warm start, few enough degrees of freedom and rows."""
    opt = mj_model.opt
    elliptic = opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    return (
        opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
        and opt.integrator in INTEGRATORS
        and opt.jacobian != mujoco.mjtJacobian.mjJAC_DENSE
        and opt.iterations > 0
        and opt.noslip_iterations == 0
        and not opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART
        and not opt.enableflags & (mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_ENERGY)
        and mj_model.nflex == 0
        and 0 < mj_model.nv <= MOST_DOFS
        and njmax > 0
        and floats_per_world(mj_model.nv, njmax, elliptic=bool(elliptic), rows_on_chip=njmax) <= SHARED_FLOATS
    )


def step(warp_model: mjw.Model, warp_data_E: mjw.Data, *, sensors: bool) -> None:
    """Launch a physics step: that of MuJoCo Warp, with this solver.

    Args:
        warp_model: with `opt.run_qacc_smooth` off, since the solver does not need that acceleration.
        warp_data_E: the worlds.
        sensors: whether to compute them; they never change the state that is reached.
    """
    m, d = warp_model, warp_data_E
    mjw.fwd_position(m, d, factorize=False)
    if sensors:
        d.sensordata.zero_()
        mjw.sensor_pos(m, d)
    mjw.fwd_velocity(m, d)
    if sensors:
        mjw.sensor_vel(m, d)
    mjw.fwd_actuation(m, d)
    mjw.fwd_acceleration(m, d, factorize=True)
    solve(m, d)
    if sensors:
        if m.sensor_rne_postconstraint:
            mjw.rne_postconstraint(m, d)
        mjw.sensor_acc(m, d, skip_rne_postconstraint=True)
    if m.opt.integrator == mjw.IntegratorType.EULER:
        mjw.euler(m, d)
    else:
        mjw.implicit(m, d)


def solve(
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    worlds_per_block: int = WORLDS_PER_BLOCK,
    min_blocks: int = 0,
    rows_on_chip: int | None = None,
    scratch: wp.array2d[float] | None = None,
) -> None:
    """Launch the solver: accelerations and constraint forces from the rows of `warp_data_E`, which must be sparse.

    Args:
        warp_model: a model that `suits`.
        warp_data_E: the worlds.
        worlds_per_block: how many worlds share a block on CUDA; fewer where their memory does not fit.
        min_blocks: how many blocks a multiprocessor is to hold at once, which bounds the registers; 0 does not.
    """
    m, d = warp_model, warp_data_E
    elliptic = bool(m.opt.cone == mjw.ConeType.ELLIPTIC)
    on_cuda = d.qpos.device.is_cuda
    lanes = CUDA_LANES if on_cuda else 1
    if rows_on_chip is None:
        rows_on_chip = d.njmax
    if scratch is None:
        scratch = wp.empty((1, 1), dtype=float, device=d.qpos.device)
    fitting = SHARED_FLOATS // floats_per_world(m.nv, d.njmax, elliptic=elliptic, rows_on_chip=rows_on_chip)
    worlds = min(worlds_per_block, fitting) if on_cuda else 1
    kernel = newton_kernel(
        nv=m.nv,
        njmax=d.njmax,
        elliptic=elliptic,
        ls_iterations=int(m.opt.ls_iterations),
        lanes=lanes,
        worlds_per_block=worlds,
        rows_on_chip=rows_on_chip,
        min_blocks=min_blocks if on_cuda else 0,
    )
    wp.launch(kernel, dim=(d.nworld, lanes), inputs=arguments(m, d, scratch), block_dim=worlds * lanes)


def arguments(m: mjw.Model, d: mjw.Data, scratch: wp.array2d[float]) -> list[object]:
    """Return what the kernel reads, then what it writes."""
    efc = d.efc
    return [
        int(m.opt.iterations),
        m.opt.tolerance,
        m.opt.ls_tolerance,
        m.opt.impratio_invsqrt,
        m.M_hinit_i,
        m.M_colind,
        d.ne,
        d.nf,
        d.nefc,
        d.M,
        d.qacc_warmstart,
        d.qfrc_smooth,
        d.contact.friction,
        efc.type,
        efc.id,
        efc.J_rownnz,
        efc.J_rowadr,
        efc.J_colind.reshape((efc.J_colind.shape[0], -1)),
        efc.J.reshape((efc.J.shape[0], -1)),
        efc.D,
        efc.aref,
        efc.frictionloss,
        scratch,
        d.qacc,
        efc.Ma,
        efc.force,
        efc.state,
        d.qfrc_constraint,
        d.solver_niter,
        d.overflow,
    ]
