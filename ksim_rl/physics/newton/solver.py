"""Chooses the constraint solver of a world, and launches the one that is a single kernel."""

from collections.abc import Callable
from functools import partial

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.native import FEW_WORLDS
from ksim_rl.physics.newton.kernel import CUDA_LANES, launcher, layout, put_longest_first
from ksim_rl.physics.newton.limbs import limbs_of
from ksim_rl.physics.sim_cfg import SimCfg
from ksim_rl.physics.upstream import may_sleep

# The shared memory that a block has without asking for more, in floats.
SHARED_FLOATS = 48 * 1024 // 4
# Floats of shared memory of a world, so that ten live on a multiprocessor together. Of many worlds eleven do, if
# an eighth of the rows fit (H200, 32768 worlds of G1, own substeps: 11.88 ms; with ten 11.93, with twelve 12.14).
FLOATS_PER_WORLD = 5536
FLOATS_OF_MANY = 5048
# Where njmax alone takes that much, as of robots whose feet touch many prisms of a height field, fewer worlds live on a
# multiprocessor anyway, and rows in shared memory count for more (H200, 4096 worlds of G1 with 162 rows in the mean,
# njmax 840: 0.69 ms a solve with none of them there, 0.58 with 162, 0.54 with 322).
# A multiprocessor has 228 KiB of shared memory, of which each block takes another KiB, and in each quarter, where
# warps stay, 512 registers for a lane. With 72 of them as many worlds of Go1 run in parallel as the memory lets, 28.
# With 96 only 20 do, and fewer values lie in memory meanwhile, which is faster where most worlds run in parallel anyway
# (H200, 4096 worlds: 119 us, 125 with 72; 32768: 776 and 722). Where more than 128 are left, no bound is needed.
SHARED_BYTES = 228 * 1024
LEAST_REGISTERS = (96, 72)
MOST_REGISTERS = 128
MOST_DOFS = 64
# MuJoCo Warp's solver ends its loop by a conditional node, which costs more than the few iterations that it saves
# (H200, 4096 worlds, at most 10 iterations: Go1 8.22 ms without and 8.46 with it, G1 9.88 and 10.17).
MOST_UNCONDITIONAL_ITERATIONS = 10
INTEGRATORS = (
    mujoco.mjtIntegrator.mjINT_EULER,
    mujoco.mjtIntegrator.mjINT_IMPLICIT,
    mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
)


def unsuited(mj_model: mujoco.MjModel, *, njmax: int) -> str | None:
    """Return why the kernel cannot solve this model, or None where it can."""
    # The layout with no row in shared memory is the least that the kernel needs.
    opt = mj_model.opt
    nv = mj_model.nv
    elliptic = bool(opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC)
    limbs = limbs_of(mj_model.dof_parentid.tolist())
    floats = layout(
        nv, njmax, limbs, ntendon=mj_model.ntendon, elliptic=elliptic, rows_in_shared=0
    )["FLOATS"]
    reasons = {
        "the solver is not Newton's": opt.solver != mujoco.mjtSolver.mjSOL_NEWTON,
        f"the integrator is {mujoco.mjtIntegrator(opt.integrator).name}": opt.integrator
        not in INTEGRATORS,
        "the Jacobian is dense": opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE,
        "no iterations are allowed": opt.iterations < 1,
        "there are noslip iterations": opt.noslip_iterations > 0,
        "warm starts are off": bool(opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART),
        "bodies may sleep": may_sleep(opt),
        "energies are computed": bool(opt.enableflags & mujoco.mjtEnableBit.mjENBL_ENERGY),
        "there are flexes": mj_model.nflex > 0,
        f"there are {nv} degrees of freedom, outside of 1 to {MOST_DOFS}": not 0 < nv <= MOST_DOFS,
        "there are no constraint rows (njmax)": njmax < 1,
        f"{njmax} constraint rows (njmax) do not fit shared memory": floats > SHARED_FLOATS,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def one_kernel_unavailable(mj_model: mujoco.MjModel, sim: SimCfg, *, njmax: int) -> str | None:
    """Return why the worlds of this model take MuJoCo Warp's own solver, or None where one kernel solves them."""
    if not sim.one_kernel_solver:
        return "sim.one_kernel_solver is False"
    return unsuited(mj_model, njmax=njmax)


def takes_conditional_nodes(warp_model: mjw.Model, *, supported: bool) -> bool:
    """Whether the loop of MuJoCo Warp's own solver is to end when all worlds have converged."""
    # Up to that many iterations, a fixed loop is faster than a test after each.
    return supported and int(warp_model.opt.iterations) > MOST_UNCONDITIONAL_ITERATIONS


def most_registers(floats: int, num_worlds: int) -> int | None:
    """Return how many registers let as many worlds run in parallel as shared memory does, or None for any number."""
    # Blocks per multiprocessor by shared memory, of one warp each, then registers by the warps of a quarter, in eights.
    at_once = SHARED_BYTES // (4 * floats + 1024)
    most = max(LEAST_REGISTERS[num_worlds > FEW_WORLDS], 512 // -(-at_once // 4) // 8 * 8)
    if most <= MOST_REGISTERS:
        return most
    return None


def solver(
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    rows_in_shared: int | None = None,
    broken: wp.array | None = None,
) -> Callable[..., None]:
    """Return a launcher of the solver: accelerations and forces from the constraint rows, which must be sparse.

    On CUDA it orders the worlds before: with `solves=False` it does that alone, with `orders=False` it does not.

    Args:
        warp_model, warp_data_E: a model that is not `unsuited`, and its worlds, with arrays in their final place.
        rows_in_shared: None takes the measured best: half of the rows, which few worlds exceed, where they fit.
        broken: int32 [E], makes a debug build, which adds to each world's number the `Invariant`s that do not hold.
    """
    m = warp_model
    d = warp_data_E
    efc = warp_data_E.efc
    elliptic = bool(m.opt.cone == mjw.ConeType.ELLIPTIC)
    device = d.qpos.device
    on_cuda = d.qpos.device.is_cuda
    limbs = limbs_of(m.dof_parentid.numpy().tolist())
    sizes_with = partial(layout, m.nv, d.njmax, limbs, ntendon=m.ntendon, elliptic=elliptic)
    # Shared memory without any row of the Jacobian; the rest is filled with rows.
    sizes = sizes_with(rows_in_shared=0)
    stride = sizes["STRIDE"]
    narrow = sizes["NARROW"]
    if rows_in_shared is None:
        # Of many worlds, eleven run at the same time if an eighth of the rows finds room; see FLOATS_OF_MANY.
        is_tight = (
            d.nworld > FEW_WORLDS and sizes["FLOATS"] + d.njmax // 8 * narrow <= FLOATS_OF_MANY
        )
        if is_tight:
            most_floats = FLOATS_OF_MANY
        elif sizes["FLOATS"] > FLOATS_PER_WORLD:
            # Some bytes less than a block may have: Warp takes a few of its own.
            most_floats = SHARED_FLOATS - 64
        else:
            most_floats = FLOATS_PER_WORLD
        room = most_floats - sizes["FLOATS"]
        if on_cuda:
            # Half of the rows suffice: few worlds have more.
            rows_in_shared = min(-(-d.njmax // 2), max(0, room // narrow))
        else:
            rows_in_shared = d.njmax
    sizes = sizes_with(rows_in_shared=rows_in_shared)
    # Rows beyond are in global memory, in rows of full width.
    far_floats = (d.njmax - rows_in_shared * narrow // stride) * stride
    own = {
        "efc_J_colind": efc.J_colind.reshape((d.nworld, -1)),
        "efc_J": efc.J.reshape((d.nworld, -1)),
        "scratch": wp.empty((d.nworld, far_floats), dtype=float, device=device),
        **{
            name: wp.array(table, dtype=int, device=device)
            for name, table in limbs.tables(m.nv).items()
        },
        # The worlds are in the order of their numbers until the first sort.
        "order": wp.array(list(range(d.nworld)), dtype=int, device=device),
        "broken": wp.empty(0, dtype=int, device=device) if broken is None else broken,
    }
    if on_cuda:
        lanes = CUDA_LANES
        registers = most_registers(sizes["FLOATS"], d.nworld)
    else:
        lanes = 1
        registers = None
    solve = launcher(
        m, d, own, sizes, lanes=lanes, max_registers=registers, checked=broken is not None
    )

    def launch(*, orders: bool = True, solves: bool = True) -> None:
        # The CPU takes the worlds one after the other, so that an order gains nothing.
        if orders and on_cuda:
            put_longest_first(own["order"], d)
        if solves:
            solve()

    return launch
