"""These Warp kernels do what a substep or reset of MuJoCo Warp leaves undone."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

import warp as wp


@wp.kernel(enable_backward=False)
def sparse_velocity(
    rownnz: wp.array2d[int],
    rowadr: wp.array2d[int],
    colind: wp.array2d[int],
    matrix: wp.array2d[float],
    qvel: wp.array2d[float],
    velocity: wp.array2d[float],
):
    """Multiply each world's sparse matrix by qvel; its pattern is the world's own, or shared by all."""
    world, row = wp.tid()
    pattern = world % rownnz.shape[0]
    total = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    for i in range(rowadr[pattern, row], rowadr[pattern, row] + rownnz[pattern, row]):
        total += matrix[world, i] * qvel[world, colind[pattern, i]]
    velocity[world, row] = total
