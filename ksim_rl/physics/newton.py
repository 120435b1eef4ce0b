"""The constraint solver of the substeps: one kernel per substep where the model allows it, else MuJoCo Warp's own."""

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.newton_kernel import floats_per_world, newton_kernel
from ksim_rl.physics.newton_lanes import CUDA_LANES

# The shared memory that a block has without asking for more, in floats, and how many worlds share it at best.
SHARED_FLOATS = 48 * 1024 // 4
WORLDS_PER_BLOCK = 4
MOST_DOFS = 64


def is_one_kernel(warp_model: mjw.Model, warp_data_E: mjw.Data) -> bool:
    """Whether the kernel solves this model: Newton from a warm start, with sparse rows, and small enough."""
    m, d = warp_model, warp_data_E
    elliptic = m.opt.cone == mjw.ConeType.ELLIPTIC
    return (
        m.opt.solver == mjw.SolverType.NEWTON
        and m.is_sparse
        and m.opt.integrator != mjw.IntegratorType.DISCRETE
        and not m.opt.disableflags & mjw.DisableBit.WARMSTART
        and not m.opt.enableflags & mjw.EnableBit.SLEEP
        and m.opt.noslip_iterations == 0
        and m.opt.iterations > 0
        and d.njmax > 0
        and 0 < m.nv <= MOST_DOFS
        and floats_per_world(m.nv, d.njmax, elliptic=elliptic) <= SHARED_FLOATS
    )


def solve(warp_model: mjw.Model, warp_data_E: mjw.Data, *, worlds_per_block: int = WORLDS_PER_BLOCK, min_blocks: int = 0) -> None:
    """Launch the solver: accelerations and constraint forces from the rows of `warp_data_E`."""
    m, d = warp_model, warp_data_E
    elliptic = bool(m.opt.cone == mjw.ConeType.ELLIPTIC)
    on_cuda = d.qpos.device.is_cuda
    lanes = CUDA_LANES if on_cuda else 1
    fits = SHARED_FLOATS // floats_per_world(m.nv, d.njmax, elliptic=elliptic)
    worlds = min(worlds_per_block, fits) if on_cuda else 1
    kernel = newton_kernel(
        nv=m.nv,
        njmax=d.njmax,
        elliptic=elliptic,
        ls_iterations=int(m.opt.ls_iterations),
        lanes=lanes,
        worlds_per_block=worlds,
        min_blocks=min_blocks if on_cuda else 0,
    )
    efc = d.efc
    wp.launch(
        kernel,
        dim=(d.nworld, lanes),
        inputs=[
            int(m.opt.iterations),
            m.opt.tolerance,
            m.opt.ls_tolerance,
            m.opt.impratio_invsqrt,
            m.M_rownnz,
            m.M_rowadr,
            m.M_hinit_i,
            m.M_colind,
            m.M_mulm_rowadr,
            m.M_mulm_col,
            m.M_mulm_madr,
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
            efc.J_colind.reshape((d.nworld, -1)),
            efc.J.reshape((d.nworld, -1)),
            efc.D,
            efc.aref,
            efc.frictionloss,
            d.dof_frictionadr,
            efc.jtdaj_adr,
            efc.jtdaj_nrow,
            efc.jtdaj_nblock,
        ],
        outputs=[d.qacc, efc.Ma, efc.force, efc.state, d.qfrc_constraint, d.solver_niter, d.overflow],
        block_dim=worlds * lanes,
    )
