"""Products and systems of small matrices in full precision, and planes through points."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

FLAT_ENOUGH = 0.1
"""The most that points may vary across a plane, as a share of their second largest variance."""


def product(a: Float[Tensor, "*a N K"], b: Float[Tensor, "*b K M"]) -> Float[Tensor, "*batch N M"]:
    """Return the matrix product for small K, in full precision.

    `a @ b` would keep three digits on a GPU, once a trainer has set `torch.set_float32_matmul_precision("high")`.
    """
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)


def solved(a_ENN: Float[Tensor, "E N N"], b_EN: Float[Tensor, "E N"]) -> Float[Tensor, "E N"]:
    """Return x of a x = b for symmetric positive definite a, small N.

    `torch.linalg.solve` makes the host wait. Such a matrix needs no pivots.
    """
    size = b_EN.shape[1]
    rows_ENM = torch.cat((a_ENN, b_EN[..., None]), dim=-1)
    is_row_NN1 = torch.eye(size, dtype=torch.bool, device=b_EN.device)[..., None]
    for place in range(size):
        row_E1M = rows_ENM[:, place : place + 1] / rows_ENM[:, place : place + 1, place : place + 1]
        others_ENM = rows_ENM - rows_ENM[:, :, place : place + 1] * row_E1M
        rows_ENM = torch.where(is_row_NN1[place], row_E1M, others_ENM)
    return rows_ENM[..., -1]


def plane_normal(points_EN3: Float[Tensor, "E N 3"]) -> Float[Tensor, "E 3"]:
    """Return the upward unit normal of the plane that points lie closest to, or the z axis where they lie on none.

    Distances are measured across the plane, not along z. They lie on none where their variance across it is more than
    a tenth of the second largest one, or where they are not finite. All in closed form, since a decomposition by
    `torch.linalg` makes the host wait. The formula gives the eigenvalues of a symmetric 3 x 3 matrix (Smith,
    Communications of the ACM 4(4), 1961, p. 168).
    """
    # Differences of variances decide: single precision would leave three digits of them.
    points_EN3 = points_EN3.double()
    spread_EN3 = points_EN3 - points_EN3.mean(dim=1, keepdim=True)
    # The covariance, but for a factor.
    cov_E33 = product(spread_EN3.mT, spread_EN3)
    finite_E = torch.isfinite(cov_E33).flatten(1).all(-1)
    unit_33 = torch.eye(3, dtype=torch.float64, device=points_EN3.device)
    cov_E33 = torch.where(finite_E[:, None, None], cov_E33, unit_33)
    mean_E = cov_E33.diagonal(dim1=-2, dim2=-1).mean(-1)
    rest_E33 = cov_E33 - mean_E[:, None, None] * unit_33
    radius_E = (rest_E33.square().sum((-2, -1)) / 6.0).sqrt()
    tiny = torch.finfo(torch.float64).tiny
    scaled_E33 = rest_E33 / radius_E.clamp_min(tiny)[:, None, None]
    cosine_E = (_determinant(scaled_E33) / 2.0).clamp(-1.0, 1.0)
    angle_E = torch.arccos(cosine_E) / 3.0
    largest_E = mean_E + 2.0 * radius_E * torch.cos(angle_E)
    # Rounding may leave a variance below 0.
    least_E = (mean_E + 2.0 * radius_E * torch.cos(angle_E + 2.0 * math.pi / 3.0)).clamp_min(0.0)
    middle_E = 3.0 * mean_E - largest_E - least_E
    # Of rank 2: cross products of its rows are along the eigenvector that it lacks, and the longest is the best one.
    singular_E33 = cov_E33 - least_E[:, None, None] * unit_33
    crossed_E33 = torch.linalg.cross(singular_E33, singular_E33.roll(-1, dims=1))
    longest_E = crossed_E33.square().sum(-1).argmax(-1)
    normal_E3 = crossed_E33.gather(1, longest_E[:, None, None].expand(-1, 1, 3))[:, 0]
    length_E1 = torch.linalg.vector_norm(normal_E3, dim=-1, keepdim=True)
    normal_E3 = normal_E3 / length_E1.clamp_min(tiny)
    normal_E3 = torch.where(normal_E3[:, 2:] < 0.0, -normal_E3, normal_E3)
    # Points on a line have many planes.
    plane_E = (least_E < FLAT_ENOUGH * middle_E) & (middle_E > 1e-6 * largest_E) & finite_E
    return torch.where(plane_E[:, None], normal_E3, unit_33[2]).float()


def _determinant(matrix_E33: Tensor) -> Tensor:
    first, second, third = matrix_E33.unbind(-2)
    return (first * torch.linalg.cross(second, third)).sum(-1)
