"""Launches the one kernel of all constraint rows: equalities, dry friction, limits and contacts.

MuJoCo Warp launches about ten for them, whose threads take places for rows as they come, so that sums over rows round
otherwise in each run on a GPU. Here some lanes of a warp own a world, and rows stand in the order of MuJoCo's C engine.
The kernel is constraint_rows.cuh. Its sources are "Constraint
model" in https://mujoco.readthedocs.io/en/stable/computation/index.html and mujoco_warp/_src/constraint.py.
"""

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import native
from ksim_rl.physics.rows.contact_lists import ContactLists
from ksim_rl.physics.rows.second_limits import joints_between_limits

# The degrees of freedom that move a geom are bits of a number, and a geom of a pair is 15 bits of another.
MOST_DOFS = 64
MOST_GEOMS = 1 << 15
# The compiler likes 104 registers, with which this many threads are on a multiprocessor at once. Where there are more,
# 80 take less time: 6.435 ms instead of 6.566 for a control step of 32768 worlds of Go1 on an H200.
THREADS_AT_ONCE = 512
REGISTERS = 80
_KINDS = (
    "EQUALITY",
    "FRICTION_DOF",
    "LIMIT_JOINT",
    "CONTACT_FRICTIONLESS",
    "CONTACT_PYRAMIDAL",
    "CONTACT_ELLIPTIC",
)
_CONSTRAINTS = native.names_of(mujoco.mjtConstraint)
_ENUMS = {
    **{name: _CONSTRAINTS[name] for name in _KINDS},
    "BALL": mujoco.mjtJoint.mjJNT_BALL,
    "OUT_OF_NONZEROS": mjw.OverflowType.NJMAX_NNZ,
}


def one_kernel_rows_unavailable(
    warp_model: mjw.Model, *, dynamics_unavailable: str | None
) -> str | None:
    """Return why MuJoCo Warp's own kernels make a model's rows, or None where ours does, given earlier stages."""
    m = warp_model
    reasons = {
        "what precedes them is not one kernel": dynamics_unavailable is not None,
        "equality constraints tie bodies": m.eq_connect_adr.size + m.eq_wld_adr.size > 0,
        "surfaces move": bool(m.flg_surfacevel),
        f"there are more than {MOST_DOFS} degrees of freedom": m.nv > MOST_DOFS,
        f"there are more than {MOST_GEOMS} geoms": m.ngeom > MOST_GEOMS,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def constraint_rows(
    warp_model: mjw.Model, warp_data_E: mjw.Data, lists: ContactLists, *, lanes: int | None = None
) -> Callable[[], None]:
    """Return a launcher of `mjw.make_constraint` for a model with sparse rows, with arrays in their final place.

    It also makes the contact lists. Arrays that only MuJoCo Warp's own solver reads (`jtdaj_*`, `Jqvel`,
    `dof_frictionadr`) are not written. `lanes` is how many threads share a world on CUDA; None takes the usual.
    """
    m = warp_model
    d = warp_data_E
    bits = mjw.DisableBit
    flags = int(warp_model.opt.disableflags)
    # Sorted below by number: MuJoCo Warp lists balls apart from hinges and slides.
    limited = np.concatenate(
        [m.jnt_limited_ball_adr.numpy(), m.jnt_limited_slide_hinge_adr.numpy()]
    )
    # For each geom, 64 bits say which degrees of freedom move it: a contact's row needs no search.
    bodies = m.body_weldid.numpy()[m.geom_bodyid.numpy()]
    moves = m.body_isdofancestor.numpy()[bodies, : m.nv] != 0
    bit_of_dof = np.uint64(1) << np.arange(m.nv, dtype=np.uint64)
    masks = (moves * bit_of_dof).sum(-1, dtype=np.uint64)
    device = d.qpos.device
    own = {
        **vars(lists),
        # The joints with limits, and the bits of the degrees of freedom that move each geom.
        "limited": wp.array(np.sort(limited), dtype=int, device=device),
        "dofs_of_geom": wp.array(masks, dtype=wp.uint64, device=device),
        "efc_J_colind": d.efc.J_colind.reshape((d.nworld, -1)),
        "efc_J": d.efc.J.reshape((d.nworld, -1)),
    }
    # Disabled kinds of rows are compiled out.
    on = {bit: not flags & (bits.CONSTRAINT | bit) for bit in bits}
    sizes = {"num_dofs": m.nv, "njmax": d.njmax, "most_nonzeros": d.njmax_nnz}
    constants = {
        **(lists.constants | _ENUMS | sizes),
        "equalities": m.eq_jnt_adr.size if on[bits.EQUALITY] else 0,
        "limited_joints": limited.size if on[bits.LIMIT] else 0,
        "both_limits": joints_between_limits(m, ()).size > 0,
        "frictionloss": on[bits.FRICTIONLOSS],
        "contacts": on[bits.CONTACT],
        "elliptic": m.opt.cone == mjw.ConeType.ELLIPTIC,
        "refsafe": not flags & bits.REFSAFE,
    }
    # The CPU always has one lane.
    if not (lanes and device.is_cuda):
        lanes = lists.lanes
    threads = lists.threads
    # Fewer registers pay only where not all threads are on the GPU at the same time.
    waits = device.is_cuda and d.nworld * lanes > THREADS_AT_ONCE * device.sm_count
    build = native.Build(max_registers=REGISTERS if waits else None)
    header = "ksim_rl/physics/rows/constraint_rows.cuh"
    launch = native.launcher_of(
        header, constants, own, m, d, lanes=lanes, threads=threads, build=build
    )

    def make_rows() -> None:
        # First, since rows of contacts follow the order of the lists.
        lists.append()
        launch()

    return make_rows
