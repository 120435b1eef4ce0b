"""Counts the rows of ties no further than there is room for them, where worlds have too little.

MuJoCo Warp counts what ties need. The line search of its solver goes through so many rows, and beyond the last one it
reads the next world's rows, or whatever memory lies behind the last: a NaN there, and the world is not accelerated.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportArgumentType=false

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics.rows.tie_weights import rows_of_equalities


def counting_of_ties(mj_model: mujoco.MjModel, warp_data_E: mjw.Data) -> Callable[[], None] | None:
    """Return a launcher for after MuJoCo Warp's rows, with arrays in their final place; None where all ties fit."""
    d = warp_data_E
    # How many rows a flex has depends on its state.
    is_known = mj_model.nflex == 0
    if is_known and rows_of_equalities(mj_model).sum() <= d.njmax:
        return None

    def count() -> None:
        wp.launch(count_fitting_ties, dim=d.nworld, inputs=[d.njmax], outputs=[d.ne])

    return count


@wp.kernel(enable_backward=False)
def count_fitting_ties(njmax: int, ne: wp.array[int]):
    """Count no more rows of ties than a world has room for; `nefc` keeps on saying how many it needs."""
    world = wp.tid()
    ne[world] = wp.min(ne[world], njmax)
