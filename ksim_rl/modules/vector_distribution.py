"""This module has what the distributions of continuous actions share: shapes, draws without gradients, and bounds."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution, constraints


class VectorDistribution(Distribution):
    """The base of distributions over vectors that never read a value on the host.

    So they can be captured in a CUDA graph and compiled. Samples come from torch's default generator of the device.

    Args:
        loc: [..., L].
        scale: positive, broadcastable with `loc`.
    """

    arg_constraints = {"loc": constraints.real_vector, "scale": constraints.positive}  # type: ignore[assignment]
    has_rsample = True

    def __init__(self, loc: Float[Tensor, "#*batch #L"], scale: Float[Tensor, "#*batch #L"]) -> None:
        self.loc, self.scale = torch.broadcast_tensors(loc, scale)
        # Argument checks compare all values and read the answer on the host.
        super().__init__(self.loc.shape[:-1], self.loc.shape[-1:], validate_args=False)

    def sample(self, sample_shape: Any = ()) -> Float[Tensor, "*shape L"]:
        """Draw [*sample_shape, ..., L] without gradients."""
        with torch.no_grad():
            return self.rsample(sample_shape)


class BoundedDistribution(VectorDistribution):
    """The base of those whose components lie in [low, high].

    Args:
        loc, scale: as of `VectorDistribution`.
        low, high: the bounds, both numbers or both tensors [L]; low < high.
    """

    def __init__(
        self,
        loc: Float[Tensor, "#*batch #L"],
        scale: Float[Tensor, "#*batch #L"],
        low: Float[Tensor, "#L"] | float = -1.0,
        high: Float[Tensor, "#L"] | float = 1.0,
    ) -> None:
        super().__init__(loc, scale)
        self.low, self.high = low, high

    @property
    def support(self) -> constraints.Constraint:  # type: ignore[override]
        """The box [low, high]."""
        return constraints.independent(constraints.interval(self.low, self.high), 1)

    def expand(self, batch_shape: Any, _instance: Any = None) -> "BoundedDistribution":
        """Return the distribution with a larger batch shape."""
        shape = torch.Size(batch_shape) + self.event_shape
        return type(self)(self.loc.expand(shape), self.scale.expand(shape), self.low, self.high)

    def _clamp(self, value: Tensor) -> Tensor:
        return value.clamp(self.low, self.high)  # type: ignore[arg-type]
