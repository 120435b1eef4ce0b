"""Rewards may rate a value by its distance from an interval in which it is right."""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor


def tolerance(
    value: Float[Tensor, "*shape"],
    *,
    low: float = -math.inf,
    high: float = math.inf,
    margin: float,
    value_at_margin: float = 0.1,
    shape: Literal["gaussian", "linear"] = "gaussian",
) -> Float[Tensor, "*shape"]:
    """Return 1 inside [low, high], falling to `value_at_margin` at `margin` outside of it and on towards 0.

    Formula: Tassa et al., "DeepMind Control Suite" (2018), section 4. With d the distance to the interval in margins,
    "gaussian" is `value_at_margin ** (d ** 2)` and "linear" is `max(0, 1 - (1 - value_at_margin) d)`.

    Args:
        low, high: the interval, in the unit of `value`.
        margin: > 0, in the unit of `value`.
        value_at_margin: in (0, 1), or 0 for "linear".
    """
    distance = torch.clamp(torch.maximum(low - value, value - high), min=0.0) / margin
    if shape == "linear":
        return torch.clamp(1.0 - (1.0 - value_at_margin) * distance, min=0.0)
    return torch.exp(distance.square() * math.log(value_at_margin))
