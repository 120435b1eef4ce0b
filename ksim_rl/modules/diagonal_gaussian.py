"""The gaussian with a diagonal covariance, free of host syncs."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints, register_kl

_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)


class DiagonalGaussian(Distribution):
    """Normal distribution of a vector with independent components, one event per batch element.

    It equals `Independent(Normal(loc, scale), 1)`, whose `sample` (through `torch.normal`) and argument
    checks read tensor values on the host. This one never does, so it can be captured in a CUDA graph and
    compiled. Samples come from torch's default generator of the device.

    Args:
        loc: mean, shape [..., L].
        scale: standard deviation, positive, broadcastable with `loc`.
    """

    arg_constraints = {"loc": constraints.real_vector, "scale": constraints.positive}  # type: ignore[assignment]
    support = constraints.real_vector  # type: ignore[assignment]
    has_rsample = True

    def __init__(self, loc: Tensor, scale: Tensor, validate_args: bool | None = None) -> None:
        self.loc, self.scale = torch.broadcast_tensors(loc, scale)
        # Argument checks compare all values and read the answer on the host.
        super().__init__(self.loc.shape[:-1], self.loc.shape[-1:], validate_args=False)

    @property
    def mean(self) -> Tensor:
        """The mean, shape [..., L]."""
        return self.loc

    @property
    def mode(self) -> Tensor:
        """The most likely value, which is the mean, shape [..., L]."""
        return self.loc

    @property
    def deterministic_sample(self) -> Tensor:
        """What TorchRL takes under `ExplorationType.DETERMINISTIC`: the mean, shape [..., L]."""
        return self.loc

    @property
    def stddev(self) -> Tensor:
        """The standard deviation, shape [..., L]."""
        return self.scale

    @property
    def variance(self) -> Tensor:
        """The variance, shape [..., L]."""
        return self.scale.square()

    def expand(self, batch_shape: Any, _instance: Any = None) -> "DiagonalGaussian":
        """Return the distribution with a larger batch shape."""
        shape = torch.Size(batch_shape) + self.event_shape
        return DiagonalGaussian(self.loc.expand(shape), self.scale.expand(shape))

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draw [*sample_shape, ..., L] by reparametrization: gradients reach `loc` and `scale`."""
        shape = torch.Size(sample_shape) + self.loc.shape
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return self.loc + self.scale * noise

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw [*sample_shape, ..., L] without gradients."""
        with torch.no_grad():
            return self.rsample(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of `value` [..., L], shape [...]."""
        error = (value - self.loc) / self.scale
        return (-0.5 * error.square() - self.scale.log() - _HALF_LOG_2_PI).sum(-1)

    def entropy(self) -> Tensor:
        """Return the differential entropy in nats, shape [...]."""
        return (self.scale.log() + (0.5 + _HALF_LOG_2_PI)).sum(-1)


@register_kl(DiagonalGaussian, DiagonalGaussian)
def _kl(p: DiagonalGaussian, q: DiagonalGaussian) -> Tensor:
    variance_ratio = (p.scale / q.scale).square()
    error = ((p.loc - q.loc) / q.scale).square()
    return 0.5 * (variance_ratio + error - 1.0 - variance_ratio.log()).sum(-1)
