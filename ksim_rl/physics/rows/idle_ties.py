"""Takes the force from rows of connect and weld that no joint can do anything about.

The rotation of a body that only slides is tied by rows without a Jacobian and without a weight, so that each is as hard
as numbers allow: a rounding error of float32 in the poses is a force of 1e9, which moves nothing, and which views of
forces on bodies and sensors show. And C makes no rows of two bodies that never move.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics.rows.tie_weights import EQUALITY, tied_bodies

# The error that rounding makes in a tie that holds, m and rad. Beyond it, C has forces.
ROUNDING = wp.constant(1.0e-5)
LEAST_WEIGHT = 1e-10
NOT_A_TIE = 0
TIE = 1
FIXED_TIE = 2


def kinds_of_ties(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return of each equality whether rows of it may be without a Jacobian, or all are, int [neq]."""
    kinds = np.full(mj_model.neq, NOT_A_TIE, dtype=np.int32)
    for equality, bodies in enumerate(tied_bodies(mj_model)):
        if bodies[0] < 0:
            continue
        # Weights [2] of translation and rotation, of both bodies together.
        weights = mj_model.body_invweight0[bodies].sum(0)
        if mj_model.eq_type[equality] == mujoco.mjtEq.mjEQ_WELD:
            # A weld ties rotation, too; connect ties a point only.
            parts = 2
        else:
            parts = 1
        if not _moves(mj_model, bodies).any():
            kinds[equality] = FIXED_TIE
        elif (weights[:parts] < LEAST_WEIGHT).any():
            kinds[equality] = TIE
    return kinds


def _moves(mj_model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Return whether a joint moves each body: those that none does are welded to the world, or to a mocap body."""
    # A body without joints moves as the body that it is welded to.
    rigid = mj_model.body_weldid[bodies]
    return mj_model.body_dofnum[rigid] > 0


def stilling_of_ties(
    mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data
) -> Callable[[], None] | None:
    """Return a launcher for after MuJoCo Warp's rows, with arrays in their final place; None where none is idle."""
    m = warp_model
    d = warp_data_E
    kinds = kinds_of_ties(mj_model)
    if not kinds.any():
        return None
    efc = d.efc
    table = wp.array(kinds, dtype=int, device=d.qpos.device)
    # The Jacobian is one row of entries per world, or rows of all degrees of freedom.
    columns = [bool(m.is_sparse), m.nv, efc.J_rownnz, efc.J_rowadr, efc.J]
    inputs = [table, d.ne, efc.type, efc.id, efc.pos, *columns]

    def still() -> None:
        wp.launch(still_ties, dim=(d.nworld, d.njmax), inputs=inputs, outputs=[efc.D])

    return still


@wp.kernel(enable_backward=False)
def still_ties(
    kinds: wp.array[int],
    ne: wp.array[int],
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    efc_pos: wp.array2d[float],
    is_sparse: bool,
    nv: int,
    J_rownnz: wp.array2d[int],
    J_rowadr: wp.array2d[int],
    J: wp.array3d[float],
    efc_D: wp.array2d[float],
):
    """Let rows of ties without a Jacobian exert nothing, if they hold, or if no joint moves the tied bodies."""
    world, row = wp.tid()
    if row >= ne[world] or efc_type[world, row] != EQUALITY:
        return
    kind = kinds[efc_id[world, row]]
    if kind == NOT_A_TIE:
        return
    # The largest entry of the row's Jacobian: 0 where no joint moves what the row ties.
    largest = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    if is_sparse:
        start = J_rowadr[world, row]
        for entry in range(start, start + J_rownnz[world, row]):
            largest = wp.max(largest, wp.abs(J[world, 0, entry]))
    else:
        for dof in range(nv):
            largest = wp.max(largest, wp.abs(J[world, row, dof]))
    # A stiffness of 0 makes the row exert nothing.
    if largest == 0.0 and (kind == FIXED_TIE or wp.abs(efc_pos[world, row]) < ROUNDING):
        efc_D[world, row] = 0.0
