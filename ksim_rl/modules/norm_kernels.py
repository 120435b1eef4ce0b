"""The Triton kernels that add a bias, normalize rows, and apply an activation, forward and back.

A program takes some rows of one of N networks, a tile at a time, in float32. To 768 columns it is one warp, which waits
for no other. A row is two or three chunks of a power of two, as layers are that wide. Sums of columns are left in
parts, one of each program, and added up in one order: the same numbers each time.
"""

from typing import Any, Protocol

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd import Function

from ksim_rl.device.gradient_context import GradientContext

# In the order in which the kernels number them, from 1; 0 is none.
FUSED = (nn.ReLU, nn.SiLU)
EPS = tl.constexpr(1e-5)  # torch's
# Elements per thread of a chunk of three, and of two, which leave it more registers; and how many programs there are
# forward. Backward, where threads need all registers that they can have, half as many run at the same time.
ELEMENTS = {3: 8, 2: 16}
PROGRAMS = 2048
# Columns that a program of `sum_parts` adds up: two sectors of memory, and as many programs as a GPU has room for.
SUMMED = 16
ON_GPU = tl.constexpr(torch.cuda.is_available())


@triton.jit
def _sigmoid(value):
    # 3 instructions, not Triton's 12, for which these kernels wait. Its error is 3e-4, an eighth of bfloat16's.
    if ON_GPU:
        return tl.inline_asm_elementwise(
            "tanh.approx.f32 $0, $1; fma.rn.f32 $0, $0, 0f3F000000, 0f3F000000;",
            "=f,f", [0.5 * value], tl.float32, is_pure=True, pack=1,
        )  # fmt: skip
    return tl.sigmoid(value)


@triton.jit
def _of_columns(weights, WIDTH: tl.constexpr, CHUNKS: tl.constexpr, LANES: tl.constexpr):
    # A tuple of chunks stays in registers: loops over chunks are unrolled.
    found = ()
    at = weights + tl.program_id(1) * WIDTH
    for chunk in tl.static_range(CHUNKS):  # pyright: ignore[reportGeneralTypeIssues]
        column = chunk * LANES + tl.arange(0, LANES)[None, :]
        found = found + (tl.load(at + column, mask=column < WIDTH, other=0.0),)
    return found


@triton.jit
def _chunk(row, num_rows, chunk: tl.constexpr, WIDTH: tl.constexpr, LANES: tl.constexpr):
    # Returned are the places of a tile's elements, and which of them exist.
    column = chunk * LANES + tl.arange(0, LANES)[None, :]
    return row[:, None] * WIDTH + column, (row < num_rows)[:, None] & (column < WIDTH)


@triton.jit
def normalize_rows(
    features, bias, gain, offset, out, moments, num_rows, ACTIVATION: tl.constexpr,
    STEPS: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr, CHUNKS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write activation(gain * standardized(features + bias) + offset) of `STEPS * ROWS` rows.

    Program (i, n) is of network n. `moments` [N, num_rows, 2] get the mean and one over the standard deviation of each
    row, for the way back.
    """
    # Loaded once for all rows of the program.
    biases = _of_columns(bias, WIDTH, CHUNKS, LANES)
    gains = _of_columns(gain, WIDTH, CHUNKS, LANES)
    offsets = _of_columns(offset, WIDTH, CHUNKS, LANES)
    first = tl.program_id(1).to(tl.int64) * num_rows
    features = features + first * WIDTH
    out = out + first * WIDTH
    moments = moments + 2 * first
    for step in tl.range(0, STEPS, num_stages=3):  # pyright: ignore[reportGeneralTypeIssues]
        row = (tl.program_id(0) * STEPS + step) * ROWS + tl.arange(0, ROWS)  # pyright: ignore[reportGeneralTypeIssues]
        # Mean first, then squares about it: a difference of mean squares would cancel.
        values = ()
        errors = ()
        total = 0.0
        square = 0.0
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)  # pyright: ignore[reportGeneralTypeIssues]
            values = values + (
                tl.load(features + at, mask=keep, other=0.0).to(tl.float32) + biases[chunk],
            )
            total += values[chunk]
        mean = tl.sum(total, 1) / WIDTH
        for chunk in tl.static_range(CHUNKS):
            # Columns beyond the width are no part of the row; their error would be minus the mean.
            inside = chunk * LANES + tl.arange(0, LANES)[None, :] < WIDTH
            errors = errors + (tl.where(inside, values[chunk] - mean[:, None], 0.0),)
            square += errors[chunk] * errors[chunk]
        scale = 1.0 / tl.sqrt(tl.sum(square, 1) / WIDTH + EPS)
        tl.store(moments + 2 * row, mean, mask=row < num_rows)
        tl.store(moments + 2 * row + 1, scale, mask=row < num_rows)
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)
            # Scale, offset and activation, on the values that are in registers already.
            value = errors[chunk] * scale[:, None] * gains[chunk] + offsets[chunk]
            if ACTIVATION == 1:
                value = tl.maximum(value, 0.0)
            if ACTIVATION == 2:
                value = value * _sigmoid(value)
            tl.store(out + at, value.to(out.dtype.element_ty), mask=keep)


@triton.jit
def normalize_rows_back(
    d_out, features, bias, gain, offset, moments, d_features, partials, num_rows,
    ACTIVATION: tl.constexpr, WEIGHTS: tl.constexpr,
    STEPS: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr, CHUNKS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the gradient at the features of `STEPS * ROWS` rows, and with WEIGHTS the sums of the weights' gradients.

    `partials` [3, N, programs, WIDTH] get the sums of bias, gain and offset.
    """
    biases = _of_columns(bias, WIDTH, CHUNKS, LANES)
    gains = _of_columns(gain, WIDTH, CHUNKS, LANES)
    offsets = _of_columns(offset, WIDTH, CHUNKS, LANES)
    first = tl.program_id(1).to(tl.int64) * num_rows
    features = features + first * WIDTH
    d_out = d_out + first * WIDTH
    moments = moments + 2 * first
    d_features = d_features + first * WIDTH
    sums = ()
    for _ in tl.static_range(3 * CHUNKS):
        sums = sums + (tl.zeros((ROWS, LANES), dtype=tl.float32),)
    # Loads run ahead of the sums.
    for step in tl.range(0, STEPS, num_stages=3):  # pyright: ignore[reportGeneralTypeIssues]
        row = (tl.program_id(0) * STEPS + step) * ROWS + tl.arange(0, ROWS)  # pyright: ignore[reportGeneralTypeIssues]
        mean = tl.load(moments + 2 * row, mask=row < num_rows, other=0.0)[:, None]
        scale = tl.load(moments + 2 * row + 1, mask=row < num_rows, other=0.0)[:, None]
        units = ()
        slopes = ()
        of_gain = ()
        of_offset = ()
        of_bias = ()
        along = 0.0
        total = 0.0
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)  # pyright: ignore[reportGeneralTypeIssues]
            value = tl.load(features + at, mask=keep, other=0.0).to(tl.float32) + biases[chunk]
            slope = tl.load(d_out + at, mask=keep, other=0.0).to(tl.float32)
            # Computed again from the features: storing it would take as much memory traffic as reading them.
            unit = (value - mean) * scale
            value = unit * gains[chunk] + offsets[chunk]
            if ACTIVATION == 1:
                slope = tl.where(value > 0.0, slope, 0.0)
            # The derivative of v s(v) is s + v s (1 - s).
            if ACTIVATION == 2:
                share = _sigmoid(value)
                slope *= share + value * (share - share * share)
            of_gain = of_gain + (slope * unit,)
            of_offset = of_offset + (slope,)
            # Zero beyond the last row and column, as are `slope` and `scale` there.
            slope *= gains[chunk]
            along += slope * unit
            total += slope
            units = units + (unit,)
            slopes = slopes + (slope,)
        mean_along = tl.sum(along, 1)[:, None] / WIDTH
        mean_slope = tl.sum(total, 1)[:, None] / WIDTH
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)
            # The gradient through mean and standard deviation: both components that the norm removes are taken out.
            slope = (slopes[chunk] - mean_slope - units[chunk] * mean_along) * scale
            tl.store(d_features + at, slope.to(d_features.dtype.element_ty), mask=keep)
            of_bias = of_bias + (slope,)
        if WEIGHTS:
            added = of_bias + of_gain + of_offset
            found = ()
            for part in tl.static_range(3 * CHUNKS):
                found = found + (sums[part] + added[part],)
            sums = found
    if WEIGHTS:
        for part in tl.static_range(3 * CHUNKS):
            column = part % CHUNKS * LANES + tl.arange(0, LANES)
            of = part // CHUNKS * tl.num_programs(1) + tl.program_id(1)
            # One row per program, so that the sum over them has a fixed order.
            to = partials + (of * tl.num_programs(0) + tl.program_id(0)) * WIDTH + column
            tl.store(to, tl.sum(sums[part], 0), mask=column < WIDTH)


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


class _NormContext(GradientContext, Protocol):
    activation: int


class Normalized(Function):
    """Rows of N networks with a bias added, normalized (Ba et al., arXiv 1607.06450), scaled, offset and activated.

    Features keep their dtype; bias, gain and offset are float32 with N * L elements. The `activation` counts entries
    of `FUSED` from 1, and 0 is none. Gradients are the same bits each time.
    """

    @staticmethod
    def forward(
        ctx: _NormContext,
        features_NBL: Float[Tensor, "N B L"],
        bias: Float[Tensor, "*bias"],
        gain: Float[Tensor, "*gain"],
        offset: Float[Tensor, "*offset"],
        activation: int,
    ) -> Float[Tensor, "N B L"]:
        """Return the rows."""
        features = features_NBL.contiguous()
        networks, rows, width = features.shape
        out = torch.empty_like(features)
        moments_NB2 = bias.new_empty(networks, rows, 2)
        programs, tile = _cut(networks, rows, width, PROGRAMS)
        launch: Any = normalize_rows[programs, networks]
        launch(features, bias, gain, offset, out, moments_NB2, rows, activation, **tile)
        ctx.save_for_backward(features, bias, gain, offset, moments_NB2)
        ctx.activation = activation
        return out

    @staticmethod
    def backward(
        ctx: _NormContext, d_out_NBL: Float[Tensor, "N B L"]
    ) -> tuple[Float[Tensor, "*?weight"] | None, ...]:
        """Return the gradients, for the weights only where they learn."""
        features, *weights, _ = ctx.saved_tensors
        learns = any(ctx.needs_input_grad[1:4])
        networks, rows, width = features.shape
        programs, tile = _cut(networks, rows, width, PROGRAMS // 2)
        d_features = torch.empty_like(features)
        partials = weights[0].new_empty(3, networks, programs if learns else 0, width)
        given = d_out_NBL.contiguous(), *ctx.saved_tensors, d_features, partials
        launch: Any = normalize_rows_back[programs, networks]
        launch(*given, rows, ctx.activation, learns, **tile)
        if not learns:
            return d_features, None, None, None, None
        # Each gradient in one piece: autograd would copy others.
        sums = weights[0].new_empty(3, networks, width)
        launch = sum_parts[-(-width // SUMMED), 3 * networks]
        launch(partials, sums, programs, width, ROWS=256, COLUMNS=SUMMED, num_warps=8)
        return (
            d_features,
            *(own.view_as(weight) for own, weight in zip(sums, weights, strict=True)),
            None,
        )


def _cut(networks: int, rows: int, width: int, most: int) -> tuple[int, dict[str, int]]:
    """Return how many programs take the rows of a network, some `most` for all of them, and their tiles."""
    # The next power of two; three quarters of it, in three chunks, waste less where they suffice.
    power = max(1 << (width - 1).bit_length(), 4)
    if 4 * width <= 3 * power:
        chunks = 3
        lanes = power // 4
    else:
        chunks = 2
        lanes = power // 2
    # Narrow rows share a warp; wide ones get several warps.
    tall = max(32 * ELEMENTS[chunks] // lanes, 1)
    warps = max(lanes // (32 * ELEMENTS[3]), 1)
    steps = -(-rows * networks // (tall * most))
    tile = {"STEPS": steps, "ROWS": tall, "WIDTH": width, "CHUNKS": chunks, "LANES": lanes}
    return -(-rows // (tall * steps)), {**tile, "num_warps": warps}
