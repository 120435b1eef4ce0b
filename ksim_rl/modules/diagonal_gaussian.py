"""This module has the gaussian with a diagonal covariance, free of host syncs."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import constraints, register_kl

from ksim_rl.modules.vector_distribution import VectorDistribution

_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)


class DiagonalGaussian(VectorDistribution):
    """Normal distribution of a vector with independent components, one event per batch element.

    It equals `Independent(Normal(loc, scale), 1)`, whose `sample` (through `torch.normal`) and argument
    checks read tensor values on the host.

    Args:
        loc: mean, shape [..., L].
        scale: standard deviation, positive, broadcastable with `loc`.
    """

    support = constraints.real_vector  # type: ignore[assignment]

    @property
    def mean(self) -> Float[Tensor, "*batch L"]:
        """The mean."""
        return self.loc

    @property
    def mode(self) -> Float[Tensor, "*batch L"]:
        """The most likely value, which is the mean."""
        return self.loc

    @property
    def deterministic_sample(self) -> Float[Tensor, "*batch L"]:
        """What TorchRL takes under `ExplorationType.DETERMINISTIC`: the mean."""
        return self.loc

    @property
    def stddev(self) -> Float[Tensor, "*batch L"]:
        """The standard deviation."""
        return self.scale

    @property
    def variance(self) -> Float[Tensor, "*batch L"]:
        """The variance."""
        return self.scale.square()

    def expand(self, batch_shape: Any, _instance: Any = None) -> "DiagonalGaussian":
        """Return the distribution with a larger batch shape."""
        shape = torch.Size(batch_shape) + self.event_shape
        return DiagonalGaussian(self.loc.expand(shape), self.scale.expand(shape))

    def rsample(self, sample_shape: Any = ()) -> Float[Tensor, "*shape L"]:
        """Draw [*sample_shape, ..., L] by reparametrization: gradients reach `loc` and `scale`."""
        shape = torch.Size(sample_shape) + self.loc.shape
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return self.loc + self.scale * noise

    def log_prob(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*shape"]:
        """Return the log density of `value` in nats."""
        error = (value - self.loc) / self.scale
        return (-0.5 * error.square() - self.scale.log() - _HALF_LOG_2_PI).sum(-1)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the differential entropy in nats."""
        return (self.scale.log() + (0.5 + _HALF_LOG_2_PI)).sum(-1)


@register_kl(DiagonalGaussian, DiagonalGaussian)
def _kl(p: DiagonalGaussian, q: DiagonalGaussian) -> Tensor:
    variance_ratio = (p.scale / q.scale).square()
    error = ((p.loc - q.loc) / q.scale).square()
    return 0.5 * (variance_ratio + error - 1.0 - variance_ratio.log()).sum(-1)
