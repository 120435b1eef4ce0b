"""These Warp kernels keep the last substeps of each world, and find the worlds that failed."""

# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

import warp as wp


@wp.kernel(enable_backward=False)
def keep_rows(
    rows: wp.array2d[float],
    failed: wp.array[int],
    count: wp.array[int],
    ring: wp.array3d[float],
):
    """Write each world's row into the next place of its ring, unless the world has failed."""
    world, i = wp.tid()
    if failed[world] == 0:
        ring[world, count[world] % ring.shape[1], i] = rows[world, i]


@wp.kernel(enable_backward=False)
def mark_failed(
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    failed: wp.array[int],
    count: wp.array[int],
    reached_qpos: wp.array2d[float],
    reached_qvel: wp.array2d[float],
):
    """Count the substep; where the sum of the state is not finite, keep the state and stop the world's ring."""
    world = wp.tid()
    if failed[world] == 0:
        count[world] = count[world] + 1
        total = float(0.0)  # noqa: UP018 (Warp: a variable that changes in a loop)
        for i in range(qpos.shape[1]):
            total += qpos[world, i]
        for i in range(qvel.shape[1]):
            total += qvel[world, i]
        if not wp.isfinite(total):
            failed[world] = 1
            for i in range(qpos.shape[1]):
                reached_qpos[world, i] = qpos[world, i]
            for i in range(qvel.shape[1]):
                reached_qvel[world, i] = qvel[world, i]
