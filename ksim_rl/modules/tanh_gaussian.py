"""The gaussian squashed into bounds by a hyperbolic tangent, free of host syncs."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints, kl_divergence, register_kl
from torch.nn import functional

from ksim_rl.modules.diagonal_gaussian import DiagonalGaussian


class TanhGaussian(Distribution):
    """`center + half_range * tanh(u)` with `u` from a `DiagonalGaussian`, component by component.

    The density includes the change of variables, log|dy/du| = log(half_range) + 2 (log 2 - u - softplus(-2 u)), exact
    for every `u`; the usual log(1 - tanh(u)^2) underflows (Haarnoja et al., arXiv 1812.05905, appendix C). Without it
    the entropy grows with `scale` for ever, while the true one has a maximum and falls to minus infinity.

    The entropy has no closed form, so there is no `entropy`: TorchRL's losses then take
    `-rsample_and_log_prob()[1]`, an unbiased estimate whose gradient is reparametrized.

    Nothing reads tensor values on the host, so it can be captured in a CUDA graph and compiled. Samples come from
    torch's default generator of the device.

    Args:
        loc: mean of `u`, shape [..., L].
        scale: standard deviation of `u`, positive, broadcastable with `loc`.
        low, high: the bounds, both numbers or both tensors [L]; low < high.
    """

    arg_constraints = {"loc": constraints.real_vector, "scale": constraints.positive}  # type: ignore[assignment]
    has_rsample = True

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        low: Tensor | float = -1.0,
        high: Tensor | float = 1.0,
        validate_args: bool | None = None,
    ) -> None:
        self.base = DiagonalGaussian(loc, scale)
        self.loc, self.scale, self.low, self.high = self.base.loc, self.base.scale, low, high
        self._center, self._half_range = (high + low) / 2, (high - low) / 2
        # Argument checks compare all values and read the answer on the host.
        super().__init__(self.base.batch_shape, self.base.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """The box [low, high]."""
        return constraints.independent(constraints.interval(self.low, self.high), 1)

    @property
    def median(self) -> Tensor:
        """The median of each component, shape [..., L]."""
        return self._squash(self.loc)

    @property
    def deterministic_sample(self) -> Tensor:
        """What TorchRL takes under `ExplorationType.DETERMINISTIC`: the median, shape [..., L].

        The mode would lie on a bound as soon as `scale` is large.
        """
        return self.median

    def expand(self, batch_shape: Any, _instance: Any = None) -> "TanhGaussian":
        """Return the distribution with a larger batch shape."""
        base = self.base.expand(batch_shape)
        return TanhGaussian(base.loc, base.scale, self.low, self.high)

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        """Draw [*sample_shape, ..., L] by reparametrization: gradients reach `loc` and `scale`."""
        return self._squash(self.base.rsample(sample_shape))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        """Draw [*sample_shape, ..., L] without gradients."""
        with torch.no_grad():
            return self.rsample(sample_shape)

    def rsample_and_log_prob(self, sample_shape: Any = ()) -> tuple[Tensor, Tensor]:
        """Draw as `rsample`, and return the log density [*sample_shape, ...] without inverting the squashing."""
        latent = self.base.rsample(sample_shape)
        return self._squash(latent), self._log_density(latent)

    def sample_and_log_prob(self, sample_shape: Any = ()) -> tuple[Tensor, Tensor]:
        """Do the same without gradients through the sample; the log density has gradients."""
        latent = self.base.sample(sample_shape)
        return self._squash(latent), self._log_density(latent)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log density of `value` [..., L], shape [...].

        A value on a bound or beyond is taken to lie the smallest step of its precision inside.
        """
        inside = 1.0 - torch.finfo(self.loc.dtype).eps
        unit = ((value - self._center) / self._half_range).clamp(-inside, inside)
        return self._log_density(torch.atanh(unit))

    def _squash(self, latent: Tensor) -> Tensor:
        # Rounding can carry the sum past a bound, which specs would refuse.
        return (self._center + self._half_range * latent.tanh()).clamp(self.low, self.high)  # type: ignore[arg-type]

    def _log_density(self, latent: Tensor) -> Tensor:
        log_slope = 2.0 * (math.log(2.0) - latent - functional.softplus(-2.0 * latent))
        half_range = self._half_range
        log_half_range = half_range.log() if isinstance(half_range, Tensor) else math.log(half_range)
        return self.base.log_prob(latent) - (log_slope + log_half_range).sum(-1)


@register_kl(TanhGaussian, TanhGaussian)
def _kl(p: TanhGaussian, q: TanhGaussian) -> Tensor:
    # One map squashes both, and a divergence does not change under such a map. The bounds have to be the same.
    return kl_divergence(p.base, q.base)
