"""Products of small matrices in full precision."""

from jaxtyping import Float
from torch import Tensor


def product(a: Float[Tensor, "*a N K"], b: Float[Tensor, "*b K M"]) -> Float[Tensor, "*batch N M"]:
    """Return the matrix product for small K, in full precision.

    `a @ b` would keep three digits on a GPU, once a trainer has set `torch.set_float32_matmul_precision("high")`.
    """
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)
