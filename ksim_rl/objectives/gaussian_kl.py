"""This module computes how far a policy moved: the exact divergence between diagonal gaussians."""

from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution


def kl_divergence(
    loc_old: Float[Tensor, "*batch L"],
    scale_old: Float[Tensor, "*batch L"],
    loc: Float[Tensor, "*batch L"],
    scale: Float[Tensor, "*batch L"],
) -> Float[Tensor, "*batch"]:
    """Return KL(old || new) of two diagonal gaussians in nats, from means and standard deviations."""
    log_ratio = (scale_old / scale).log()
    error = ((loc_old - loc) / scale).square()
    return (0.5 * ((2.0 * log_ratio).exp() + error - 1.0) - log_ratio).sum(-1)


def gaussian_parameters(
    dist: Distribution,
) -> tuple[Float[Tensor, "*batch L"], Float[Tensor, "*batch L"]] | None:
    """Return `loc` and `scale` of a distribution built on a gaussian (squashed ones included), else None.

    The divergence between two distributions that squash their samples in the same way is that of the
    gaussians beneath them.
    """
    base = dist if hasattr(dist, "loc") else getattr(dist, "base_dist", dist)
    loc, scale = getattr(base, "loc", None), getattr(base, "scale", None)
    if isinstance(loc, Tensor) and isinstance(scale, Tensor):
        return loc, scale
    return None
