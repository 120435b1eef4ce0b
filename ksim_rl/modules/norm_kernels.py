"""This module has the Triton kernels that add a bias, normalize rows, and apply an activation, forward and back.

A program takes some rows of one of N networks, a tile of several at a time, in float32. A thread has the same columns
of all rows of a tile, so that the threads meet for the sums of rows alone. Sums of columns are left in parts, one of
each program, and added up in one order: the same numbers each time.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd import Function

# In the order in which the kernels number them, from 1; 0 is none.
FUSED = (nn.ReLU, nn.SiLU)
EPS = tl.constexpr(1e-5)  # torch's
# What a thread loads at once (16 bytes of bfloat16), and how many elements of a tile it has.
VECTOR, ELEMENTS = 8, 32
# Columns that a program of `sum_parts` adds up: two sectors of memory, and as many programs as a GPU has room for.
SUMMED = 16


@triton.jit
def _tile(step, num_rows, width, STEPS: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr):
    # Returned are the rows of a program's tile, the places of its elements, and which of them exist.
    row = (tl.program_id(0) * STEPS + step) * ROWS + tl.arange(0, ROWS)
    column = tl.arange(0, LANES)
    return row, row[:, None] * width + column[None, :], (row < num_rows)[:, None] & (column < width)[None, :]


@triton.jit
def _of_columns(weights, width, LANES: tl.constexpr):
    column = tl.arange(0, LANES)
    return tl.load(weights + tl.program_id(1) * width + column, mask=column < width, other=0.0)[None, :]


@triton.jit
def normalize_rows(
    features, bias, gain, offset, out, moments, num_rows, width,
    ACTIVATION: tl.constexpr, STEPS: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write activation(gain * standardized(features + bias) + offset) of `STEPS * ROWS` rows.

    Program (i, n) is of network n. `moments` [N, num_rows, 2] get the mean and one over the standard deviation of each
    row, for the way back.
    """
    biases, gains = _of_columns(bias, width, LANES), _of_columns(gain, width, LANES)
    offsets = _of_columns(offset, width, LANES)
    first = tl.program_id(1).to(tl.int64) * num_rows
    inside = (tl.arange(0, LANES) < width)[None, :]
    for step in tl.range(0, STEPS, num_stages=3):  # pyright: ignore[reportGeneralTypeIssues]
        row, at, keep = _tile(step, num_rows, width, STEPS, ROWS, LANES)  # pyright: ignore[reportGeneralTypeIssues]
        value = tl.load(features + first * width + at, mask=keep, other=0.0).to(tl.float32) + biases
        mean = tl.sum(value, 1) / width
        error = tl.where(inside, value - mean[:, None], 0.0)
        scale = 1.0 / tl.sqrt(tl.sum(error * error, 1) / width + EPS)
        tl.store(moments + 2 * (first + row), mean, mask=row < num_rows)
        tl.store(moments + 2 * (first + row) + 1, scale, mask=row < num_rows)
        value = error * scale[:, None] * gains + offsets
        if ACTIVATION == 1:
            value = tl.maximum(value, 0.0)
        if ACTIVATION == 2:
            value = value * tl.sigmoid(value)
        tl.store(out + first * width + at, value.to(out.dtype.element_ty), mask=keep)


@triton.jit
def normalize_rows_back(
    d_out, features, bias, gain, offset, moments, d_features, partials, num_rows, width,
    ACTIVATION: tl.constexpr, WEIGHTS: tl.constexpr,
    STEPS: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the gradient at the features of `STEPS * ROWS` rows, and with WEIGHTS the sums of those of the weights.

    `partials` [3, N, programs, width] get the sums of bias, gain and offset.
    """
    biases, gains = _of_columns(bias, width, LANES), _of_columns(gain, width, LANES)
    offsets = _of_columns(offset, width, LANES)
    first = tl.program_id(1).to(tl.int64) * num_rows
    d_bias = tl.zeros((LANES,), dtype=tl.float32)
    d_gain = tl.zeros((LANES,), dtype=tl.float32)
    d_offset = tl.zeros((LANES,), dtype=tl.float32)
    # Loads run ahead of the sums.
    for step in tl.range(0, STEPS, num_stages=3):  # pyright: ignore[reportGeneralTypeIssues]
        row, at, keep = _tile(step, num_rows, width, STEPS, ROWS, LANES)  # pyright: ignore[reportGeneralTypeIssues]
        mean = tl.load(moments + 2 * (first + row), mask=row < num_rows, other=0.0)[:, None]
        scale = tl.load(moments + 2 * (first + row) + 1, mask=row < num_rows, other=0.0)[:, None]
        value = tl.load(features + first * width + at, mask=keep, other=0.0).to(tl.float32) + biases
        slope = tl.load(d_out + first * width + at, mask=keep, other=0.0).to(tl.float32)
        unit = (value - mean) * scale
        value = unit * gains + offsets
        if ACTIVATION == 1:
            slope = tl.where(value > 0.0, slope, 0.0)
        if ACTIVATION == 2:
            share = tl.sigmoid(value)
            slope *= share * (1.0 + value * (1.0 - share))
        if WEIGHTS:
            d_gain += tl.sum(slope * unit, 0)
            d_offset += tl.sum(slope, 0)
        # Zero beyond the last row and column, as are `slope` and `scale` there.
        slope *= gains
        along = tl.sum(slope * unit, 1)[:, None] / width
        slope = (slope - tl.sum(slope, 1)[:, None] / width - unit * along) * scale
        tl.store(d_features + first * width + at, slope.to(d_features.dtype.element_ty), mask=keep)
        if WEIGHTS:
            d_bias += tl.sum(slope, 0)
    if WEIGHTS:
        column = tl.arange(0, LANES)
        programs = tl.num_programs(0)
        part = partials + (tl.program_id(1) * programs + tl.program_id(0)) * width + column
        kind = tl.num_programs(1) * programs * width
        tl.store(part, d_bias, mask=column < width)
        tl.store(part + kind, d_gain, mask=column < width)
        tl.store(part + 2 * kind, d_offset, mask=column < width)


@triton.jit
def sum_parts(parts, sums, count, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Write the sums of `count` parts [M, count, width] to `sums` [M, width]: program (i, m) takes COLUMNS of m."""
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = column < width
    parts += tl.program_id(1) * count * width + column[None, :]
    total = tl.zeros((ROWS, COLUMNS), dtype=tl.float32)
    for first in range(0, count, ROWS):
        row = first + tl.arange(0, ROWS)[:, None]
        total += tl.load(parts + row * width, mask=(row < count) & inside[None, :], other=0.0)
    tl.store(sums + tl.program_id(1) * width + column, tl.sum(total, 0), mask=inside)


class Normalized(Function):
    """Rows of N networks with a bias added, normalized (Ba et al., arXiv 1607.06450), scaled, offset and activated.

    Features keep their dtype; bias, gain and offset are float32 with N * L elements. The `activation` counts those of
    `FUSED` from 1, and 0 is none. Gradients are the same bits each time.
    """

    @staticmethod
    def forward(
        ctx: Any,
        features_NBL: Float[Tensor, "N B L"],
        bias: Float[Tensor, "*bias"],
        gain: Float[Tensor, "*gain"],
        offset: Float[Tensor, "*offset"],
        activation: int,
    ) -> Float[Tensor, "N B L"]:
        """Return the rows."""
        features = features_NBL.contiguous()
        networks, rows, width = features.shape
        out, moments_NB2 = torch.empty_like(features), bias.new_empty(networks, rows, 2)
        programs, tile = _cut(rows, width)
        launch: Any = normalize_rows[programs, networks]
        launch(features, bias, gain, offset, out, moments_NB2, rows, width, activation, **tile)
        ctx.save_for_backward(features, bias, gain, offset, moments_NB2)
        ctx.activation = activation
        return out

    @staticmethod
    def backward(ctx: Any, d_out_NBL: Float[Tensor, "N B L"]) -> tuple[Any, ...]:
        """Return the gradients; those of the weights where they learn."""
        features, *weights, _ = ctx.saved_tensors
        learns = any(ctx.needs_input_grad[1:4])
        networks, rows, width = features.shape
        programs, tile = _cut(rows, width)
        d_features = torch.empty_like(features)
        partials = weights[0].new_empty(3, networks, programs if learns else 0, width)
        given = d_out_NBL.contiguous(), *ctx.saved_tensors, d_features, partials
        launch: Any = normalize_rows_back[programs, networks]
        launch(*given, rows, width, ctx.activation, learns, **tile)
        if not learns:
            return d_features, None, None, None, None
        # Each gradient in one piece: autograd would copy others.
        sums = weights[0].new_empty(3, networks, width)
        launch = sum_parts[-(-width // SUMMED), 3 * networks]
        launch(partials, sums, programs, width, ROWS=256, COLUMNS=SUMMED, num_warps=8)
        return d_features, *(own.view_as(weight) for own, weight in zip(sums, weights, strict=True)), None


def _cut(rows: int, width: int) -> tuple[int, dict[str, int]]:
    """Return how many programs take the rows of a network, and their tiles: in all as many warps for each width."""
    lanes = 1 << (width - 1).bit_length()
    warps = min(max(lanes // (32 * VECTOR), 1), 8)
    tile = {"ROWS": max(32 * warps * ELEMENTS // lanes, 1), "STEPS": 2 * warps, "LANES": lanes}
    return -(-rows // (tile["ROWS"] * tile["STEPS"])), {**tile, "num_warps": warps}
