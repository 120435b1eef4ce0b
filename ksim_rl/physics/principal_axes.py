"""This module diagonalizes many inertia matrices at once, without a host sync."""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

import warp as wp
from jaxtyping import Float32
from torch import Tensor

from ksim_rl.device.streams import warp_scope

SWEEPS = wp.constant(6)


@wp.kernel(enable_backward=False)
def _jacobi(matrices: wp.array[wp.mat33], moments: wp.array[wp.vec3], quats: wp.array[wp.vec4]):
    i = wp.tid()
    a = matrices[i]
    axes = wp.identity(n=3, dtype=float)
    for _ in range(SWEEPS):
        for pair in range(3):
            p = wp.where(pair < 2, 0, 1)
            q = wp.where(pair < 1, 1, 2)
            off = a[p, q]
            if off != 0.0:
                ratio = (a[q, q] - a[p, p]) / (2.0 * off)
                t = 1.0 / (wp.abs(ratio) + wp.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / wp.sqrt(t * t + 1.0)
                s = t * c
                turn = wp.identity(n=3, dtype=float)
                turn[p, p] = c
                turn[q, q] = c
                turn[p, q] = s
                turn[q, p] = -s
                a = wp.transpose(turn) @ a @ turn
                a[p, q] = 0.0
                a[q, p] = 0.0
                axes = axes @ turn
    moments[i] = wp.get_diag(a)
    quat = wp.normalize(wp.quat_from_matrix(axes))
    quats[i] = wp.vec4(quat[3], quat[0], quat[1], quat[2])


def principal_axes(
    inertia_33: Float32[Tensor, "*batch 3 3"],
) -> tuple[Float32[Tensor, "*batch 3"], Float32[Tensor, "*batch 4"]]:
    """Return principal moments, and the axes' orientation (w, x, y, z); a diagonal matrix keeps its order and axes.

    By cyclic Jacobi rotations (Golub and Van Loan, section 8.5).
    """
    matrices = inertia_33.reshape(-1, 3, 3).contiguous()
    moments, quats = matrices.new_empty(matrices.shape[0], 3), matrices.new_empty(matrices.shape[0], 4)
    arrays = ((matrices, wp.mat33), (moments, wp.vec3), (quats, wp.vec4))
    with warp_scope(matrices.device):
        inputs = [wp.from_torch(tensor, dtype=dtype, return_ctype=True) for tensor, dtype in arrays]
        wp.launch(_jacobi, dim=matrices.shape[0], inputs=inputs, device=str(matrices.device))
    batch = inertia_33.shape[:-2]
    return moments.view(*batch, 3), quats.view(*batch, 4)
