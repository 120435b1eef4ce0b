"""Lays observations side by side, so that one kernel takes all of them, and splits them again."""

from collections.abc import Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor

from ksim_rl.transforms import upstream


def side_by_side(
    values: Sequence[Shaped[Tensor, "*?leaf"]], num_rows: int
) -> Shaped[Tensor, "E L"]:
    """Return values [E, ...] as the columns of one tensor [E, L], without a copy where they are that already.

    So values that one transform has split, the next one need not join. The result may share memory with the values.
    """
    vectors = [
        value if value.ndim == 2 and value.shape[0] == num_rows else value.reshape(num_rows, -1)
        for value in values
    ]
    if len(vectors) == 1:
        return vectors[0]
    # Memory is not there to be looked at while code is traced.
    if not torch.compiler.is_compiling() and (whole := _whole(vectors)) is not None:
        return whole
    return torch.cat(vectors, dim=1)


def _whole(vectors: list[Tensor]) -> Tensor | None:
    """Return the tensor whose columns, all of them and in this order, the vectors are; None if there is none."""
    # Vectors that were split from one tensor are still columns of it.
    owner = upstream.base_of(vectors[0])
    if owner is None:
        return None
    width = vectors[0].stride(0)
    # Each must begin where the one before it ends, in rows of the same width.
    offset = 0
    for vector in vectors:
        placed = upstream.base_of(vector) is owner and vector.storage_offset() == offset
        if not placed or vector.dtype != owner.dtype or vector.stride() != (width, 1):
            return None
        offset += vector.shape[1]
    # All columns of the owner, and nothing else.
    if offset != width or owner.numel() != vectors[0].shape[0] * width or not owner.is_contiguous():
        return None
    return owner.view(-1, width)


def split(
    joined_EL: Shaped[Tensor, "E L"], likes: Sequence[Shaped[Tensor, "*?leaf"]]
) -> list[Shaped[Tensor, "*?leaf"]]:
    """Return views of the columns in the shapes of these values, which `side_by_side` has joined."""
    if len(likes) == 1:
        return [
            joined_EL if joined_EL.shape == likes[0].shape else joined_EL.reshape(likes[0].shape)
        ]
    # At least 1, as there may be no rows.
    sizes = [like.numel() // max(joined_EL.shape[0], 1) for like in likes]
    parts = joined_EL.split(sizes, dim=1)
    return [
        part if part.shape == like.shape else part.reshape(like.shape)
        for part, like in zip(parts, likes, strict=True)
    ]
