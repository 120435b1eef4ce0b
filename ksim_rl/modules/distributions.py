"""The distributions of continuous actions, free of host syncs: gaussians, with and without bounds."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints, kl_divergence, register_kl
from torch.nn import functional
from torch.special import log_ndtr, ndtri

from ksim_rl import ranks

_HALF_LOG_2_PI = 0.5 * math.log(2.0 * math.pi)
# Below it exp() underflows in float32, and the inverse of the distribution function is found in another way.
_LOG_TINY = -80.0

# One bound for all components, or one for each.
Bound: TypeAlias = Tensor | float


class VectorDistribution(Distribution):
    """The base of distributions over vectors that never read a value on the host, so that they can be captured.

    Samples come from torch's default generator of the device. The `scale` is positive, and broadcastable with `loc`.
    """

    arg_constraints = {"loc": constraints.real_vector, "scale": constraints.positive}  # type: ignore[assignment]
    has_rsample = True
    _bounds: tuple[Bound, ...] = ()

    def __init__(
        self, loc: Float[Tensor, "#*batch #L"], scale: Float[Tensor, "#*batch #L"]
    ) -> None:
        self.loc, self.scale = torch.broadcast_tensors(loc, scale)
        # Argument checks compare all values and read the answer on the host.
        super().__init__(self.loc.shape[:-1], self.loc.shape[-1:], validate_args=False)

    @property
    def deterministic_sample(self) -> Float[Tensor, "*batch L"]:
        """The mode, which TorchRL takes under `ExplorationType.DETERMINISTIC`."""
        return self.mode

    def expand(
        self, batch_shape: Sequence[int], _instance: Distribution | None = None
    ) -> "VectorDistribution":
        """Return the distribution with a larger batch shape."""
        shape = torch.Size(batch_shape) + self.event_shape
        return type(self)(self.loc.expand(shape), self.scale.expand(shape), *self._bounds)


class BoundedDistribution(VectorDistribution, ABC):
    """The base of distributions whose components lie in [low, high], both numbers or both tensors [L]."""

    def __init__(
        self,
        loc: Float[Tensor, "#*batch #L"],
        scale: Float[Tensor, "#*batch #L"],
        low: Float[Tensor, "#L"] | float = -1.0,
        high: Float[Tensor, "#L"] | float = 1.0,
    ) -> None:
        super().__init__(loc, scale)
        self.low, self.high = self._bounds = low, high
        self._prepare(low, high)

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """The box [low, high]."""
        return constraints.independent(constraints.interval(self.low, self.high), 1)

    @abstractmethod
    def _prepare(self, low: Bound, high: Bound) -> None:
        """Compute quantities that several methods share, once."""

    def _clamp(self, value: Tensor) -> Tensor:
        return value.clamp(self.low, self.high)  # type: ignore[arg-type]


class DiagonalGaussian(VectorDistribution):
    """Normal distribution of a vector with independent components, one event per batch element.

    It equals `Independent(Normal(loc, scale), 1)`, whose `sample` (through `torch.normal`) and argument checks read
    tensor values on the host.
    """

    support = constraints.real_vector  # type: ignore[assignment]

    @property
    def mean(self) -> Float[Tensor, "*batch L"]:
        """The mean."""
        return self.loc

    mode = mean

    @property
    def variance(self) -> Float[Tensor, "*batch L"]:
        """The variance."""
        return self.scale.square()

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Float[Tensor, "*shape L"]:
        """Draw by reparametrization: gradients reach `loc` and `scale`."""
        # Ranks draw for their own rows, so that a run does not depend on how envs are spread.
        shape = torch.Size(sample_shape) + self.loc.shape
        noise = ranks.randn(
            shape, dim=len(sample_shape), dtype=self.loc.dtype, device=self.loc.device
        )
        return self.loc + self.scale * noise

    def log_prob(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*shape"]:
        """Return the log density of `value` in nats."""
        return self.log_densities(value).sum(-1)

    def log_densities(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*shape L"]:
        """Return the log density of each component, in nats."""
        error = (value - self.loc) / self.scale
        return -0.5 * error.square() - self.scale.log() - _HALF_LOG_2_PI

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the differential entropy in nats."""
        return (self.scale.log() + (0.5 + _HALF_LOG_2_PI)).sum(-1)


@register_kl(DiagonalGaussian, DiagonalGaussian)
def _kl_diagonal(p: DiagonalGaussian, q: DiagonalGaussian) -> Tensor:
    variance_ratio = (p.scale / q.scale).square()
    error = ((p.loc - q.loc) / q.scale).square()
    return 0.5 * (variance_ratio + error - 1.0 - variance_ratio.log()).sum(-1)


class TanhGaussian(BoundedDistribution):
    """`center + half_range * tanh(u)` with `u` from `DiagonalGaussian(loc, scale)`, component by component.

    The density includes the change of variables, log|dy/du| = log(half_range) + 2 (log 2 - u - softplus(-2 u)), exact
    for every `u`; the usual log(1 - tanh(u)^2) underflows (Haarnoja et al., arXiv 1812.05905, appendix C). Without it
    the entropy grows with `scale` for ever, while the true one has a maximum and falls to minus infinity.

    The entropy has no closed form, so there is no `entropy`: TorchRL's losses then take `-rsample_and_log_prob()[1]`,
    an unbiased estimate whose gradient is reparametrized.
    """

    def _prepare(self, low: Bound, high: Bound) -> None:
        self.base = DiagonalGaussian(self.loc, self.scale)
        self._center = (high + low) / 2
        self._half_range = (high - low) / 2

    @property
    def median(self) -> Float[Tensor, "*batch L"]:
        """The median of each component."""
        return self._squash(self.loc)

    @property
    def deterministic_sample(self) -> Float[Tensor, "*batch L"]:
        """The median; the mode would lie on a bound as soon as `scale` is large."""
        return self.median

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Float[Tensor, "*shape L"]:
        """Draw by reparametrization: gradients reach `loc` and `scale`."""
        return self._squash(self.base.rsample(sample_shape))

    def rsample_and_log_prob(
        self, sample_shape: torch.Size | tuple[int, ...] = ()
    ) -> tuple[Float[Tensor, "*shape L"], Float[Tensor, "*shape"]]:
        """Draw as `rsample`, and return the log density without inverting the squashing."""
        # The density is computed from u: inverting the tanh would lose digits near the bounds.
        latent = self.base.rsample(sample_shape)
        return self._squash(latent), self._log_density(latent)

    def sample_and_log_prob(
        self, sample_shape: torch.Size | tuple[int, ...] = ()
    ) -> tuple[Float[Tensor, "*shape L"], Float[Tensor, "*shape"]]:
        """Do the same without gradients through the sample; the log density has gradients."""
        latent = self.base.sample(sample_shape)
        return self._squash(latent), self._log_density(latent)

    def log_prob(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*shape"]:
        """Return the log density in nats; a value beyond the bounds has the density of the last value inside."""
        return self._log_density(self.latent(value))

    def latent(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*value L"]:
        """Return the `u` of a value; a value beyond the bounds has the `u` of the last value inside."""
        # Of the value: parameters of fewer bits would take most actions near a bound for others.
        inside = 1.0 - torch.finfo(value.dtype).eps
        return torch.atanh(((value - self._center) / self._half_range).clamp(-inside, inside))

    def _squash(self, latent: Tensor) -> Tensor:
        # Rounding can carry the sum past a bound, which specs would refuse.
        return self._clamp(self._center + self._half_range * latent.tanh())

    def _log_density(self, latent: Tensor) -> Tensor:
        # The logarithm of 1 - tanh(u)^2, in a form that is exact for large |u| too.
        log_slope = 2.0 * (math.log(2.0) - latent - functional.softplus(-2.0 * latent))
        half_range = self._half_range
        if isinstance(half_range, Tensor):
            log_half_range = half_range.log()
        else:
            log_half_range = math.log(half_range)
        terms = self.base.log_densities(latent) - log_slope - log_half_range
        if torch.compiler.is_compiling():
            # The compiler would add up the terms of a sum by few, long threads. No product rounds float64.
            ones = torch.ones(terms.shape[-1], 1, dtype=torch.float64, device=terms.device)
            return (terms.to(torch.float64) @ ones).squeeze(-1).to(terms.dtype)
        return terms.sum(-1)


@register_kl(TanhGaussian, TanhGaussian)
def _kl_tanh(p: TanhGaussian, q: TanhGaussian) -> Tensor:
    # One map squashes both, and a divergence does not change under such a map. The bounds have to be the same.
    return kl_divergence(p.base, q.base)


class TruncatedGaussian(BoundedDistribution):
    """A `DiagonalGaussian` given that each component lies in [low, high]; `loc` and `scale` are those before.

    Every quantity is computed for the mirror image whose interval lies left of `loc`, from logarithms of the
    distribution function, which neither underflow nor cancel where `loc` is far from the interval; in float32 the log
    density is then good to 0.03 nats at 40 standard deviations. Entropy, moments and divergence are exact (Johnson,
    Kotz and Balakrishnan, "Continuous univariate distributions", vol. 1, 1994, ch. 13.10.1).
    """

    def _prepare(self, low: Bound, high: Bound) -> None:
        left = (low - self.loc) / self.scale
        right = (high - self.loc) / self.scale
        # Left of loc both distribution functions are small, and their difference keeps its digits.
        mirrored = left + right > 0.0
        self._sign = torch.where(mirrored, -1.0, 1.0).to(self.loc.dtype)
        # The bounds in standard deviations from loc, in the mirror image where that is taken.
        self._a = torch.where(mirrored, -right, left)
        self._b = torch.where(mirrored, -left, right)
        self._log_cdf_a = log_ndtr(self._a)
        self._log_cdf_b = log_ndtr(self._b)
        self._log_mass = self._log_cdf_b + (-torch.expm1(self._log_cdf_a - self._log_cdf_b)).log()

    @property
    def mode(self) -> Float[Tensor, "*batch L"]:
        """The most likely value: `loc`, or the bound next to it."""
        return self._clamp(self.loc)

    @property
    def mean(self) -> Float[Tensor, "*batch L"]:
        """The mean."""
        return self.loc + self._sign * self.scale * self._moments()[0]

    @property
    def variance(self) -> Float[Tensor, "*batch L"]:
        """The variance."""
        first, second = self._moments()
        return self.scale.square() * (second - first.square())

    def rsample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Float[Tensor, "*shape L"]:
        """Draw; gradients are of the value at a fixed probability (Figurnov et al., arXiv 1805.08498)."""
        shape = torch.Size(sample_shape) + self.loc.shape
        with torch.no_grad():
            a = self._a
            b = self._b
            eps = torch.finfo(self.loc.dtype).eps
            share = ranks.rand(
                shape, dim=len(sample_shape), dtype=self.loc.dtype, device=self.loc.device
            )
            # Zero would be the lower bound itself, whose logarithm may be minus infinity.
            share = share.clamp_min(eps)
            # The share is mapped between both ends of the distribution function, in logarithms.
            cdf_ratio = (self._log_cdf_a - self._log_cdf_b).exp()
            log_cdf = self._log_cdf_b + (share + (1.0 - share) * cdf_ratio).log()
            z = torch.minimum(torch.maximum(_inverse_log_ndtr(log_cdf), a), b)
            value = self._clamp(self.loc + self._sign * self.scale * z)
            # How much each bound pulls the value along when loc or scale move.
            weight_a = (1.0 - share) * (0.5 * (z.square() - a.square())).exp()
            weight_b = share * (0.5 * (z.square() - b.square())).exp()
            by_loc = 1.0 - weight_a - weight_b
            by_scale = self._sign * (z - a * weight_a - b * weight_b)
        # Value zero, slope one: the terms add gradients to a value that was drawn without any.
        return (
            value
            + (self.loc - self.loc.detach()) * by_loc
            + (self.scale - self.scale.detach()) * by_scale
        )

    def log_prob(self, value: Float[Tensor, "*value L"]) -> Float[Tensor, "*shape"]:
        """Return the log density of `value` in nats; minus infinity outside of the bounds."""
        error = (value - self.loc) / self.scale
        log_density = -0.5 * error.square() - self.scale.log() - _HALF_LOG_2_PI - self._log_mass
        inside = (value >= self.low) & (value <= self.high)
        return torch.where(inside, log_density, -torch.inf).sum(-1)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """Return the differential entropy in nats."""
        second = self._moments()[1]
        return (self.scale.log() + _HALF_LOG_2_PI + self._log_mass + 0.5 * second).sum(-1)

    def _moments(self) -> tuple[Tensor, Tensor]:
        """Return the mean and the mean square of the standardized variable, in the mirror image where it is taken."""
        density_a = (-0.5 * self._a.square() - _HALF_LOG_2_PI - self._log_mass).exp()
        density_b = (-0.5 * self._b.square() - _HALF_LOG_2_PI - self._log_mass).exp()
        mean_square = 1.0 + self._a * density_a - self._b * density_b
        return density_a - density_b, mean_square


def _inverse_log_ndtr(log_cdf: Tensor) -> Tensor:
    """Return z with log Phi(z) = `log_cdf`, also where Phi(z) underflows."""
    near = ndtri(log_cdf.clamp_min(_LOG_TINY).exp())
    # Newton's steps from the leading term of the tail; |z| + 1 / |z| is the slope of log Phi there.
    tail = log_cdf.clamp_max(_LOG_TINY)
    far = (-2.0 * tail).sqrt()
    far = (-2.0 * (tail + _HALF_LOG_2_PI + far.log())).sqrt()
    for _ in range(2):
        far = far + (log_ndtr(-far) - tail) / (far + 1.0 / far)
    return torch.where(log_cdf > _LOG_TINY, near, -far)


@register_kl(TruncatedGaussian, TruncatedGaussian)
def _kl_truncated(p: TruncatedGaussian, q: TruncatedGaussian) -> Tensor:
    # The bounds have to be the same: a value that p can give and q cannot would make it infinite.
    first, second = p._moments()
    gap = (p.loc - q.loc) / q.scale
    ratio = p.scale / q.scale
    error = gap.square() + 2.0 * gap * ratio * (p._sign * first) + ratio.square() * second
    return (q._log_mass - p._log_mass - ratio.log() + 0.5 * (error - second)).sum(-1)
