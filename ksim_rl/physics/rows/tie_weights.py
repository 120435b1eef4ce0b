"""Gives the rows of connect and weld the weights of the bodies that they tie, as the C engine does.

MuJoCo Warp's sparse rows take the weight of the body with joints that a body is welded to, such as of a hand instead of
the tool frame in it, which is lighter or heavier by any factor.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

EQUALITY = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_EQUALITY))
MINVAL = wp.constant(float(mujoco.mjMINVAL))
BODY_EQUALITIES = (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD)
# Connect ties a point, weld a frame; others tie a scalar.
ROWS = {mujoco.mjtEq.mjEQ_CONNECT: 3, mujoco.mjtEq.mjEQ_WELD: 6}


def rows_of_equalities(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return how many constraint rows each equality constraint has, int [neq]; 1 for flexes, whose count varies."""
    rows = [ROWS.get(mujoco.mjtEq(kind), 1) for kind in mj_model.eq_type]
    return np.array(rows, dtype=np.int64)


def tied_bodies(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the two bodies that each equality constraint ties, -1 for one that ties others, [neq, 2]."""
    bodies = np.stack([mj_model.eq_obj1id, mj_model.eq_obj2id], axis=-1)
    # Ties between sites tie the bodies that carry them.
    of_sites = mj_model.eq_objtype == mujoco.mjtObj.mjOBJ_SITE
    bodies[of_sites] = mj_model.site_bodyid[bodies[of_sites]]
    bodies[~np.isin(mj_model.eq_type, BODY_EQUALITIES)] = -1
    return bodies


def weighing_of_ties(
    mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data
) -> Callable[[], None] | None:
    """Return a launcher for after MuJoCo Warp's rows, with arrays in their final place; None where they are right."""
    m = warp_model
    d = warp_data_E
    bodies = tied_bodies(mj_model)
    # Rows between bodies that carry joints themselves are right already.
    carriers = np.where(bodies < 0, -1, mj_model.body_weldid[bodies])
    bodies[(bodies == carriers).all(-1)] = -1
    if not m.is_sparse or (bodies < 0).all():
        return None
    tables = [wp.array(table, dtype=wp.vec2i, device=d.qpos.device) for table in (bodies, carriers)]

    def weigh() -> None:
        inputs = [*tables, m.body_invweight0, d.ne, d.efc.type, d.efc.id]
        wp.launch(weigh_ties, dim=(d.nworld, d.njmax), inputs=inputs, outputs=[d.efc.D])

    return weigh


@wp.kernel(enable_backward=False)
def weigh_ties(
    bodies: wp.array[wp.vec2i],
    carriers: wp.array[wp.vec2i],
    body_invweight0: wp.array2d[wp.vec2],
    ne: wp.array[int],
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    efc_D: wp.array2d[float],
):
    """Scale D, which is inverse to the weight, of the rows of `bodies`, which were made for their `carriers`."""
    world, row = wp.tid()
    if row >= ne[world] or efc_type[world, row] != EQUALITY:
        return
    # Ties whose weights are right have -1 in `bodies`.
    equality = efc_id[world, row]
    if bodies[equality][0] < 0:
        return
    # A weld has three rows of translation, which three of rotation follow.
    part = int(0)  # noqa: UP018 (Warp: a variable that changes)
    third_before = wp.max(row - 3, 0)
    if (
        row >= 3
        and efc_type[world, third_before] == EQUALITY
        and efc_id[world, third_before] == equality
    ):
        part = 1
    of_world = world % body_invweight0.shape[0]
    present = float(0.0)  # noqa: UP018
    wanted = float(0.0)  # noqa: UP018
    for side in range(2):
        present += body_invweight0[of_world, carriers[equality][side]][part]
        wanted += body_invweight0[of_world, bodies[equality][side]][part]
    # Bodies that nothing moves have no weight to scale.
    if present > 0.0:
        efc_D[world, row] = 1.0 / wp.max(wanted / (present * efc_D[world, row]), MINVAL)
