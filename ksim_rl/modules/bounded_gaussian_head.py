"""The last layer of a gaussian policy whose actions stay within bounds."""

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from ksim_rl.modules.gaussian_head import GaussianHead
from ksim_rl.modules.tanh_gaussian import TanhGaussian
from ksim_rl.modules.truncated_gaussian import TruncatedGaussian


class TanhGaussianHead(GaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TanhGaussian`, before the tanh.

    Args:
        low, high: bounds of the action [action_dim].
        **options: of `GaussianHead`.
    """

    low: Tensor
    high: Tensor

    def __init__(self, feature_dim: int, *, low: Tensor, high: Tensor, **options: Any) -> None:
        super().__init__(feature_dim, low.shape[-1], **options)
        device = options.get("device")
        # They are the env's, so they are no part of a checkpoint.
        self.register_buffer("low", low.to(device, copy=True), persistent=False)
        self.register_buffer("high", high.to(device, copy=True), persistent=False)

    def distribution(self, loc: Tensor, scale: Tensor) -> Distribution:
        """Return the distribution of the action."""
        return TanhGaussian(loc, scale, self.low, self.high)


class TruncatedGaussianHead(TanhGaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TruncatedGaussian`, in units of the action.

    `loc` stays within the bounds, by a tanh, so that no quantity of the distribution loses precision.
    """

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return `(loc, scale)`."""
        loc, scale = super().forward(features)
        center, half_range = (self.high + self.low) / 2, (self.high - self.low) / 2
        return center + half_range * torch.tanh(loc), half_range * scale

    def distribution(self, loc: Tensor, scale: Tensor) -> Distribution:
        """Return the distribution of the action."""
        return TruncatedGaussian(loc, scale, self.low, self.high)
