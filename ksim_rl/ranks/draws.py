"""Draws torch's random numbers, so that each rank gets its own rows.

All ranks draw the rows of all ranks, in step, so that their generators stay equal, and each keeps its own rows: the
same numbers that one process with all rows would draw. With one rank these are torch's functions. Rows lie along
the dim `dim`; `options` are torch's dtype and device.
"""

from collections.abc import Callable, Sequence
from typing import TypedDict, Unpack

import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.device.group import first_row, size


class TensorOptions(TypedDict, total=False):
    """The keywords of torch's functions that make a tensor."""

    dtype: torch.dtype
    device: torch.device | str


def rand(
    shape: Sequence[int], *, dim: int = 0, **options: Unpack[TensorOptions]
) -> Shaped[Tensor, "*shape"]:
    """Draw from the uniform distribution on [0, 1)."""
    return _own(torch.rand, shape, dim, options)


def randn(
    shape: Sequence[int], *, dim: int = 0, **options: Unpack[TensorOptions]
) -> Shaped[Tensor, "*shape"]:
    """Draw from the standard normal distribution."""
    return _own(torch.randn, shape, dim, options)


def randint(
    high: int, shape: Sequence[int], *, dim: int = 0, **options: Unpack[TensorOptions]
) -> Shaped[Tensor, "*shape"]:
    """Draw integers from {0, ..., high - 1}, each with the same probability."""
    return _own(lambda whole, **options: torch.randint(high, whole, **options), shape, dim, options)


def exponential(
    shape: Sequence[int], *, dim: int = 0, **options: Unpack[TensorOptions]
) -> Shaped[Tensor, "*shape"]:
    """Draw from the exponential distribution of mean 1."""
    return _own(
        lambda whole, **options: torch.empty(whole, **options).exponential_(), shape, dim, options
    )


def _own(
    draw: Callable[..., Tensor], shape: Sequence[int], dim: int, options: TensorOptions
) -> Tensor:
    if size() == 1:
        return draw(shape, **options)
    # As many rows as all ranks have together.
    whole = list(shape)
    whole[dim] *= size()
    return draw(whole, **options).narrow(dim, first_row(shape[dim]), shape[dim])
