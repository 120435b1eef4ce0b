"""Tensors that are made once, shared by all who ask for the same numbers, and never change."""

from jaxtyping import Shaped
from torch import Tensor

_CONSTANTS: list[Tensor] = []


def as_constant(tensor: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Return a tensor that is kept for ever, and make it known to those who look for writes into it."""
    _CONSTANTS.append(tensor)
    return tensor


def constants() -> list[Shaped[Tensor, "*?shape"]]:
    """Return all constants so far."""
    return list(_CONSTANTS)
