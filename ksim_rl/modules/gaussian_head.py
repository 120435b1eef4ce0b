"""This module has the last layers of gaussian policies, with and without bounds of the action."""

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution
from torch.nn import functional

from ksim_rl.modules.diagonal_gaussian import DiagonalGaussian
from ksim_rl.modules.mlp import linear
from ksim_rl.modules.tanh_gaussian import TanhGaussian
from ksim_rl.modules.truncated_gaussian import TruncatedGaussian

MIN_STD = 1e-3


class GaussianHead(nn.Module):
    """Maps features [..., L] to `loc` and `scale`, each [..., action_dim].

    Args:
        feature_dim: L.
        init_std: standard deviation of every action at the start.
        std_type: "scalar": the parameter is the standard deviation; "log": it is its logarithm. With
            `state_dependent_std` the parameter is the output of a second layer, which starts at `init_std`
            for every state; "scalar" then passes it through a softplus, so that it stays positive.
        output_gain: scale of the last layer's orthogonal weights.
    """

    parameter_names = ("loc", "scale")

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        *,
        init_std: float,
        std_type: str,
        state_dependent_std: bool,
        output_gain: float,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.std_type = std_type
        self.loc = linear(feature_dim, action_dim, gain=output_gain, device=device)
        self.std_layer: nn.Linear | None = None
        self.std: nn.Parameter | None = None
        if state_dependent_std:
            # softplus(x) = init_std at x = log(exp(init_std) - 1).
            offset = math.log(init_std) if std_type == "log" else math.log(math.expm1(init_std))
            self.std_layer = linear(feature_dim, action_dim, gain=0.0, device=device)
            nn.init.constant_(self.std_layer.bias, offset)
        else:
            start = math.log(init_std) if std_type == "log" else init_std
            self.std = nn.Parameter(torch.full((action_dim,), start, device=device))

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `(loc, scale)`; `scale` is at least `MIN_STD`."""
        loc = self.loc(features)
        if self.std_layer is None:
            assert self.std is not None
            scale = self.std.exp() if self.std_type == "log" else self.std
        else:
            raw = self.std_layer(features)
            scale = raw.exp() if self.std_type == "log" else functional.softplus(raw)
        # A std that the optimizer pushes to zero or below would give NaN log-probabilities. The gradient
        # passes the bound (a plain clamp stops it), so that a std below it can come back.
        bounded = scale + (scale.clamp_min(MIN_STD) - scale).detach()
        return loc, bounded.expand_as(loc)

    def distribution(self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]) -> Distribution:
        """Return the distribution of the action."""
        return DiagonalGaussian(loc, scale)


class TanhGaussianHead(GaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TanhGaussian`, before the tanh.

    Args:
        low_L, high_L: bounds of the action.
        **options: of `GaussianHead`.
    """

    low: Tensor
    high: Tensor

    def __init__(
        self, feature_dim: int, *, low_L: Float[Tensor, " L"], high_L: Float[Tensor, " L"], **options: Any
    ) -> None:
        super().__init__(feature_dim, len(low_L), **options)
        device = options.get("device")
        # They are the env's, so they are no part of a checkpoint.
        self.register_buffer("low", low_L.to(device, copy=True), persistent=False)
        self.register_buffer("high", high_L.to(device, copy=True), persistent=False)

    def distribution(self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]) -> Distribution:
        """Return the distribution of the action."""
        return TanhGaussian(loc, scale, self.low, self.high)


class TruncatedGaussianHead(TanhGaussianHead):
    """Maps features [..., L] to `loc` and `scale` of a `TruncatedGaussian`, in units of the action.

    `loc` stays within the bounds, by a tanh, so that no quantity of the distribution loses precision.
    """

    def forward(
        self, features: Float[Tensor, "*batch L"]
    ) -> tuple[Float[Tensor, "*batch action_dim"], Float[Tensor, "*batch action_dim"]]:
        """Return `(loc, scale)`."""
        loc, scale = super().forward(features)
        center, half_range = (self.high + self.low) / 2, (self.high - self.low) / 2
        return center + half_range * torch.tanh(loc), half_range * scale

    def distribution(self, loc: Float[Tensor, "*batch L"], scale: Float[Tensor, "*batch L"]) -> Distribution:
        """Return the distribution of the action."""
        return TruncatedGaussian(loc, scale, self.low, self.high)
