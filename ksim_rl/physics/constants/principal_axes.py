"""Diagonalizes a batch of inertia matrices without a host sync."""

import warp as wp
from jaxtyping import Float32
from torch import Tensor

from ksim_rl.device.streams import warp_scope


@wp.kernel(enable_backward=False)
def _diagonalize(
    matrices: wp.array[wp.mat33d], moments: wp.array[wp.vec3d], quats: wp.array[wp.vec4d]
):
    i = wp.tid()
    axes, diagonal = wp.eig3(matrices[i])
    moments[i] = diagonal
    quat = wp.normalize(wp.quat_from_matrix(axes))
    quats[i] = wp.vec4d(quat[3], quat[0], quat[1], quat[2])


def principal_axes(
    inertia_33: Float32[Tensor, "*batch 3 3"],
) -> tuple[Float32[Tensor, "*batch 3"], Float32[Tensor, "*batch 4"]]:
    """Return principal moments, and the axes' orientation (w, x, y, z); a diagonal matrix keeps its order and axes."""
    # In float64: given float32, Warp's iteration stops far short of float32 accuracy.
    matrices = inertia_33.reshape(-1, 3, 3).double().contiguous()
    moments = matrices.new_empty(matrices.shape[0], 3)
    quats = matrices.new_empty(matrices.shape[0], 4)
    arrays = ((matrices, wp.mat33d), (moments, wp.vec3d), (quats, wp.vec4d))
    with warp_scope(matrices.device):
        inputs = [wp.from_torch(tensor, dtype=dtype, return_ctype=True) for tensor, dtype in arrays]
        wp.launch(_diagonalize, dim=matrices.shape[0], inputs=inputs, device=str(matrices.device))
    batch = inertia_33.shape[:-2]
    return moments.view(*batch, 3).float(), quats.view(*batch, 4).float()
