"""This module has the gaussian squashed into bounds by a hyperbolic tangent, free of host syncs."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import kl_divergence, register_kl
from torch.nn import functional

from ksim_rl.modules.diagonal_gaussian import DiagonalGaussian
from ksim_rl.modules.vector_distribution import BoundedDistribution


class TanhGaussian(BoundedDistribution):
    """`center + half_range * tanh(u)` with `u` from a `DiagonalGaussian`, component by component.

    The density includes the change of variables, log|dy/du| = log(half_range) + 2 (log 2 - u - softplus(-2 u)), exact
    for every `u`; the usual log(1 - tanh(u)^2) underflows (Haarnoja et al., arXiv 1812.05905, appendix C). Without it
    the entropy grows with `scale` for ever, while the true one has a maximum and falls to minus infinity.

    The entropy has no closed form, so there is no `entropy`: TorchRL's losses then take
    `-rsample_and_log_prob()[1]`, an unbiased estimate whose gradient is reparametrized.

    Args:
        loc: mean of `u`, shape [..., L].
        scale: standard deviation of `u`, positive, broadcastable with `loc`.
        low, high: the bounds, both numbers or both tensors [L]; low < high.
    """

    def __init__(
        self,
        loc: Float[Tensor, "#*batch #L"],
        scale: Float[Tensor, "#*batch #L"],
        low: Float[Tensor, "#L"] | float = -1.0,
        high: Float[Tensor, "#L"] | float = 1.0,
    ) -> None:
        super().__init__(loc, scale, low, high)
        self.base = DiagonalGaussian(loc, scale)
        self._center, self._half_range = (high + low) / 2, (high - low) / 2

    @property
    def median(self) -> Float[Tensor, "*batch L"]:
        """The median of each component."""
        return self._squash(self.loc)

    @property
    def deterministic_sample(self) -> Float[Tensor, "*batch L"]:
        """What TorchRL takes under `ExplorationType.DETERMINISTIC`: the median.

        The mode would lie on a bound as soon as `scale` is large.
        """
        return self.median

    def rsample(self, sample_shape: Any = ()) -> Float[Tensor, "*shape L"]:
        """Draw [*sample_shape, ..., L] by reparametrization: gradients reach `loc` and `scale`."""
        return self._squash(self.base.rsample(sample_shape))

    def rsample_and_log_prob(
        self, sample_shape: Any = ()
    ) -> tuple[Float[Tensor, "*shape L"], Float[Tensor, "*shape"]]:
        """Draw as `rsample`, and return the log density [*sample_shape, ...] without inverting the squashing."""
        latent = self.base.rsample(sample_shape)
        return self._squash(latent), self._log_density(latent)

    def sample_and_log_prob(
        self, sample_shape: Any = ()
    ) -> tuple[Float[Tensor, "*shape L"], Float[Tensor, "*shape"]]:
        """Do the same without gradients through the sample; the log density has gradients."""
        latent = self.base.sample(sample_shape)
        return self._squash(latent), self._log_density(latent)

    def log_prob(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*shape"]:
        """Return the log density of `value` in nats.

        A value on a bound or beyond is taken to lie the smallest step of its precision inside.
        """
        inside = 1.0 - torch.finfo(self.loc.dtype).eps
        unit = ((value - self._center) / self._half_range).clamp(-inside, inside)
        return self._log_density(torch.atanh(unit))

    def _squash(self, latent: Tensor) -> Tensor:
        # Rounding can carry the sum past a bound, which specs would refuse.
        return self._clamp(self._center + self._half_range * latent.tanh())

    def _log_density(self, latent: Tensor) -> Tensor:
        log_slope = 2.0 * (math.log(2.0) - latent - functional.softplus(-2.0 * latent))
        half_range = self._half_range
        log_half_range = half_range.log() if isinstance(half_range, Tensor) else math.log(half_range)
        return self.base.log_prob(latent) - (log_slope + log_half_range).sum(-1)


@register_kl(TanhGaussian, TanhGaussian)
def _kl(p: TanhGaussian, q: TanhGaussian) -> Tensor:
    # One map squashes both, and a divergence does not change under such a map. The bounds have to be the same.
    return kl_divergence(p.base, q.base)
