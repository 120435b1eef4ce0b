"""This module has the layers that run in bfloat16, and their Triton kernels: products, norms and activations.

A program of a norm takes some rows of one of N networks, a tile at a time, in float32. To 768 columns it is one warp,
which waits for no other. A row is two or three chunks of a power of two, as layers are that wide. Sums of columns are
left in parts, one of each program, and added up in one order: the same numbers each time. Where one kernel makes both
product and norm, rows stay in its registers: to write and to read them is most of the time of two.
"""

import math
from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn import functional

# In the order in which the kernels number them, from 1; 0 is none.
FUSED = (nn.ReLU, nn.SiLU)
SPLITS = 4  # see `Layer`
EPS = tl.constexpr(1e-5)  # torch's
# What a thread loads at once (16 bytes of bfloat16), and how many programs there are on the way there. On the way back,
# where a thread needs all registers that it can have, half as many run at once.
VECTOR, PROGRAMS = 8, 2048
# Columns that a program of `sum_parts` adds up: two sectors of memory, and as many programs as a GPU has room for.
SUMMED = 16
ON_GPU = tl.constexpr(torch.cuda.is_available())
# Whether there is the shared memory that `_tile` needs.
JOINS = torch.cuda.is_available() and torch.cuda.get_device_capability()[0] == 9


@triton.jit
def _sigmoid(value):
    # 4 instructions instead of Triton's 12: these kernels wait for instructions more than for memory.
    if ON_GPU:
        return tl.inline_asm_elementwise(
            "ex2.approx.ftz.f32 $0, $1; add.f32 $0, $0, 0f3F800000; rcp.approx.ftz.f32 $0, $0;",
            "=f,f", [-1.4426950408889634 * value], tl.float32, is_pure=True, pack=1,
        )  # fmt: skip
    return tl.sigmoid(value)


@triton.jit
def _of_columns(weights, WIDTH: tl.constexpr, CHUNKS: tl.constexpr, LANES: tl.constexpr):
    found, at = (), weights + tl.program_id(1) * WIDTH
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
    biases, gains = _of_columns(bias, WIDTH, CHUNKS, LANES), _of_columns(gain, WIDTH, CHUNKS, LANES)
    offsets = _of_columns(offset, WIDTH, CHUNKS, LANES)
    first = tl.program_id(1).to(tl.int64) * num_rows
    features, out, moments = features + first * WIDTH, out + first * WIDTH, moments + 2 * first
    for step in tl.range(0, STEPS, num_stages=3):  # pyright: ignore[reportGeneralTypeIssues]
        row = (tl.program_id(0) * STEPS + step) * ROWS + tl.arange(0, ROWS)  # pyright: ignore[reportGeneralTypeIssues]
        values, errors, total, square = (), (), 0.0, 0.0
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)  # pyright: ignore[reportGeneralTypeIssues]
            values = values + (tl.load(features + at, mask=keep, other=0.0).to(tl.float32) + biases[chunk],)
            total += values[chunk]
        mean = tl.sum(total, 1) / WIDTH
        for chunk in tl.static_range(CHUNKS):
            inside = chunk * LANES + tl.arange(0, LANES)[None, :] < WIDTH
            errors = errors + (tl.where(inside, values[chunk] - mean[:, None], 0.0),)
            square += errors[chunk] * errors[chunk]
        scale = 1.0 / tl.sqrt(tl.sum(square, 1) / WIDTH + EPS)
        tl.store(moments + 2 * row, mean, mask=row < num_rows)
        tl.store(moments + 2 * row + 1, scale, mask=row < num_rows)
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)
            value = errors[chunk] * scale[:, None] * gains[chunk] + offsets[chunk]
            if ACTIVATION == 1:
                value = tl.maximum(value, 0.0)
            if ACTIVATION == 2:
                value = value * _sigmoid(value)
            tl.store(out + at, value.to(out.dtype.element_ty), mask=keep)


@triton.jit
def normalize_rows_back(
    d_out, features, bias, gain, offset, moments, d_features, partials, num_rows,
    ACTIVATION: tl.constexpr, BIASED: tl.constexpr, WEIGHTS: tl.constexpr,
    STEPS: tl.constexpr, ROWS: tl.constexpr, WIDTH: tl.constexpr, CHUNKS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the gradient at the features of `STEPS * ROWS` rows, and with WEIGHTS the sums of those of the weights.

    `partials` [3, N, programs, WIDTH] get the sums of bias, gain and offset. BIASED features have the bias already.
    """
    biases, gains = _of_columns(bias, WIDTH, CHUNKS, LANES), _of_columns(gain, WIDTH, CHUNKS, LANES)
    offsets = _of_columns(offset, WIDTH, CHUNKS, LANES)
    first = tl.program_id(1).to(tl.int64) * num_rows
    features, d_out, moments = features + first * WIDTH, d_out + first * WIDTH, moments + 2 * first
    d_features, sums = d_features + first * WIDTH, ()
    for _ in tl.static_range(3 * CHUNKS):
        sums = sums + (tl.zeros((ROWS, LANES), dtype=tl.float32),)
    # Loads run ahead of the sums.
    for step in tl.range(0, STEPS, num_stages=3):  # pyright: ignore[reportGeneralTypeIssues]
        row = (tl.program_id(0) * STEPS + step) * ROWS + tl.arange(0, ROWS)  # pyright: ignore[reportGeneralTypeIssues]
        mean = tl.load(moments + 2 * row, mask=row < num_rows, other=0.0)[:, None]
        scale = tl.load(moments + 2 * row + 1, mask=row < num_rows, other=0.0)[:, None]
        units, slopes, of_gain, of_offset, of_bias, along, total = (), (), (), (), (), 0.0, 0.0
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)  # pyright: ignore[reportGeneralTypeIssues]
            value = tl.load(features + at, mask=keep, other=0.0).to(tl.float32)
            value += 0.0 if BIASED else biases[chunk]
            slope = tl.load(d_out + at, mask=keep, other=0.0).to(tl.float32)
            unit = (value - mean) * scale
            value = unit * gains[chunk] + offsets[chunk]
            if ACTIVATION == 1:
                slope = tl.where(value > 0.0, slope, 0.0)
            if ACTIVATION == 2:
                share = _sigmoid(value)
                slope *= share + value * (share - share * share)
            of_gain, of_offset = of_gain + (slope * unit,), of_offset + (slope,)
            # Zero beyond the last row and column, as are `slope` and `scale` there.
            slope *= gains[chunk]
            along += slope * unit
            total += slope
            units, slopes = units + (unit,), slopes + (slope,)
        mean_along, mean_slope = tl.sum(along, 1)[:, None] / WIDTH, tl.sum(total, 1)[:, None] / WIDTH
        for chunk in tl.static_range(CHUNKS):
            at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)
            slope = (slopes[chunk] - mean_slope - units[chunk] * mean_along) * scale
            tl.store(d_features + at, slope.to(d_features.dtype.element_ty), mask=keep)
            of_bias = of_bias + (slope,)
        if WEIGHTS:
            added, found = of_bias + of_gain + of_offset, ()
            for part in tl.static_range(3 * CHUNKS):
                found = found + (sums[part] + added[part],)
            sums = found
    if WEIGHTS:
        for part in tl.static_range(3 * CHUNKS):
            column = part % CHUNKS * LANES + tl.arange(0, LANES)
            of = part // CHUNKS * tl.num_programs(1) + tl.program_id(1)
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


@triton.jit
def _opened(rounded, use):
    # By other code each time: the compiler would keep float32 from one use to the next, in twice the registers.
    if ON_GPU:
        return tl.inline_asm_elementwise(
            "shl.b32 $0, $2, 16; and.b32 $1, $2, 0xffff0000; // " + use,
            "=f,=f,r", [rounded], tl.float32, is_pure=True, pack=2,
        )  # fmt: skip
    return rounded.to(tl.float32)


@triton.jit
def multiply_and_normalize(
    inputs, weights, bias, gain, offset, features, moments, out, num_rows, stride, ACTIVATION: tl.constexpr,
    KEPT: tl.constexpr, FAN_IN: tl.constexpr, WIDTH: tl.constexpr, CHUNKS: tl.constexpr, LANES: tl.constexpr,
    ROWS: tl.constexpr, DEPTH: tl.constexpr, STAGES: tl.constexpr,
):  # fmt: skip
    """Write activation(gain * standardized(features) + offset) of ROWS rows; features are inputs @ weights + bias.

    Program (i, n) is of network n, whose inputs begin `stride` after those before. Rows of weights are whole 16 bytes.
    With KEPT features, rounded, and moments are there for the way back, as `normalize_rows` has them.
    """
    PADDED: tl.constexpr = (WIDTH + 7) // 8 * 8
    network, row = tl.program_id(1).to(tl.int64), tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    depth, lane, sums = tl.arange(0, DEPTH), tl.arange(0, LANES)[None, :], ()
    biases, first_row = _of_columns(bias, WIDTH, CHUNKS, LANES), network * num_rows
    # Rows beyond the last are the last one; they are not written.
    inputs += network * stride + tl.minimum(row, num_rows - 1)[:, None] * FAN_IN + depth[None, :]
    weights += (network * FAN_IN + depth[:, None]) * PADDED + lane
    for chunk in tl.static_range(CHUNKS):  # pyright: ignore[reportGeneralTypeIssues]
        sums = sums + (tl.zeros((ROWS, LANES), dtype=tl.float32) + biases[chunk],)
    for first in tl.range(0, FAN_IN, DEPTH, num_stages=STAGES):  # pyright: ignore[reportGeneralTypeIssues]
        inside, added = depth < FAN_IN - first, ()
        given = tl.load(inputs + first, mask=inside[None, :], other=0.0)
        for chunk in tl.static_range(CHUNKS):  # pyright: ignore[reportGeneralTypeIssues]
            keep = inside[:, None] & (chunk * LANES + lane < WIDTH)
            part = tl.load(weights + first * PADDED + chunk * LANES, mask=keep, other=0.0)
            added = added + (tl.dot(given, part, sums[chunk]),)
        sums = added
    values, total, square = (), 0.0, 0.0
    for chunk in tl.static_range(CHUNKS):  # pyright: ignore[reportGeneralTypeIssues]
        values = values + (sums[chunk].to(out.dtype.element_ty),)
        value = _opened(values[chunk], "moments")
        total += tl.sum(value, 1)
        square += tl.sum(value * value, 1)
    mean = total / WIDTH
    # float32 loses less by this than features lost when they were rounded.
    scale = 1.0 / tl.sqrt(tl.maximum(square / WIDTH - mean * mean, 0.0) + EPS)
    for chunk in tl.static_range(CHUNKS):  # pyright: ignore[reportGeneralTypeIssues]
        at, keep = _chunk(row, num_rows, chunk, WIDTH, LANES)
        column, inside = network * WIDTH + chunk * LANES + lane, chunk * LANES + lane < WIDTH
        gains = tl.load(gain + column, mask=inside, other=0.0)
        offsets = tl.load(offset + column, mask=inside, other=0.0)
        value = (_opened(values[chunk], "out") - mean[:, None]) * scale[:, None] * gains + offsets
        if ACTIVATION == 1:
            value = tl.maximum(value, 0.0)
        if ACTIVATION == 2:
            value = value * _sigmoid(value)
        tl.store(out + first_row * WIDTH + at, value.to(out.dtype.element_ty), mask=keep)
        # Not before: the compiler would go on with values as this has them, and keep them twice.
        if KEPT:
            tl.store(features + first_row * WIDTH + at, values[chunk], mask=keep)
    if KEPT:
        tl.store(moments + 2 * (first_row + row), mean, mask=row < num_rows)
        tl.store(moments + 2 * (first_row + row) + 1, scale, mask=row < num_rows)


class Layer(Function):
    """Products [N, B, M] of features [N, B, K] and weights [N, K, M], with a norm and an activation or without.

    Features [1, B, K] are those of all networks. Weights of one network are [M, K], as torch has them, and there
    `rounded` as well. The `norm` is bias, gain and offset, float32 with N * M elements each, and an activation of
    `FUSED`, from 1. Gradients need what is `kept`. They are the same bits each time, and lie in memory as what they are
    of, since autograd copies what does not. That of weights is a sum over env states in SPLITS parts: its outputs
    alone, which are few, would occupy a part of the GPU.
    """

    @staticmethod
    def forward(
        ctx: Any, features_NBK: Float[Tensor, "#N B K"], weight: Float[Tensor, "*weight"],
        rounded_NKM: Float[Tensor, "N K_padded M_padded"], kept: bool, *norm: Any,
    ) -> Float[Tensor, "N B M"]:  # fmt: skip
        """Return the outputs, in the precision of the rounded weights."""
        ctx.alone = weight.dim() == 2
        fan_in, width = ctx.sizes = weight.mT.shape if ctx.alone else weight.shape[1:]
        (networks, depth), rows = rounded_NKM.shape[:2], features_NBK.shape[1]
        ctx.is_shared, ctx.dtype = len(features_NBK) < networks, features_NBK.dtype
        # What all networks read is cast once, unless weights learn by it: their gradient would copy it again.
        given = features_NBK.expand(networks if ctx.needs_input_grad[1] else -1, -1, -1)
        given = _padded(given, -fan_in % 8, rounded_NKM.dtype).contiguous().expand(networks, -1, -1)
        # One kernel is faster while weights are few: each of its programs reads all.
        ctx.joined = bool(norm) and JOINS and width <= 768 and depth * width <= 768 * 384
        if not ctx.joined:
            features = torch.bmm(given, rounded_NKM)[..., :width]
        if not norm:
            ctx.save_for_backward(given, rounded_NKM)
            return features
        *vectors, ctx.activation = norm
        left = rows if kept or not ctx.joined else 0
        out, moments_NB2 = given.new_empty(networks, rows, width), vectors[0].new_empty(networks, left, 2)
        if ctx.joined:
            features, tile = given.new_empty(networks, left, width), _tile(networks * rows, depth, width)
            launch: Any = multiply_and_normalize[-(-rows // tile["ROWS"]), networks]
            sizes = rows, given.stride(0), ctx.activation, kept, depth, width
            launch(given, rounded_NKM, *vectors, features, moments_NB2, out, *sizes, **tile)
        else:
            features, (programs, tile) = features.contiguous(), _cut(networks, rows, width, PROGRAMS)
            launch = normalize_rows[programs, networks]
            launch(features, *vectors, out, moments_NB2, rows, ctx.activation, **tile)
        ctx.save_for_backward(given, rounded_NKM, features, *vectors, moments_NB2)
        return out

    @staticmethod
    def backward(ctx: Any, d_out_NBM: Float[Tensor, "N B M"]) -> tuple[Any, ...]:
        """Return the gradients; those of weights and vectors where they learn."""
        given, rounded, *saved = ctx.saved_tensors
        (fan_in, fan_out), (networks, rows) = ctx.sizes, given.shape[:2]
        d_out, d_features, d_weight, d_norm = d_out_NBM, None, None, [None] * len(saved[1:])
        if saved:
            learns, vectors = any(ctx.needs_input_grad[4:7]), saved[1:4]
            programs, tile = _cut(networks, rows, fan_out, PROGRAMS // 2)
            d_out = torch.empty_like(saved[0])
            partials = vectors[0].new_empty(3, networks, programs if learns else 0, fan_out)
            launch: Any = normalize_rows_back[programs, networks]
            sizes = rows, ctx.activation, ctx.joined, learns
            launch(d_out_NBM.contiguous(), *saved, d_out, partials, *sizes, **tile)
            if learns:
                sums = vectors[0].new_empty(3, networks, fan_out)
                launch = sum_parts[-(-fan_out // SUMMED), 3 * networks]
                launch(partials, sums, programs, fan_out, ROWS=256, COLUMNS=SUMMED, num_warps=8)
                d_norm[:3] = [own.view_as(vector) for own, vector in zip(sums, vectors, strict=True)]
        d_out = _padded(d_out, -fan_out % 8, rounded.dtype)
        if ctx.needs_input_grad[0]:
            d_features = torch.bmm(d_out, rounded.mT)[..., :fan_in].to(ctx.dtype)
            d_features = d_features.sum(0, keepdim=True) if ctx.is_shared else d_features
        if ctx.needs_input_grad[1]:
            splits = math.gcd(SPLITS, rows)
            parts = [part.reshape(networks * splits, rows // splits, -1) for part in (given, d_out)]
            if ctx.alone:
                parts, fan_in, fan_out = parts[::-1], fan_out, fan_in
            sums = torch.bmm(parts[0].mT, parts[1]).unflatten(0, (networks, splits))
            d_weight = sums[..., :fan_in, :fan_out].sum(1, dtype=torch.float32)
            d_weight = d_weight[0] if ctx.alone else d_weight
        return d_features, d_weight, None, None, *d_norm


def _cut(networks: int, rows: int, width: int, most: int) -> tuple[int, dict[str, int]]:
    """Return how many programs take the rows of a network, some `most` for all of them, and their tiles."""
    power = max(1 << (width - 1).bit_length(), 4)
    chunks, lanes = (3, power // 4) if 4 * width <= 3 * power else (2, power // 2)
    tall, warps = max(32 * VECTOR // lanes, 1), max(lanes // (32 * VECTOR), 1)
    steps = -(-rows * networks // (tall * most))
    tile = {"STEPS": steps, "ROWS": tall, "WIDTH": width, "CHUNKS": chunks, "LANES": lanes}
    return -(-rows // (tall * steps)), {**tile, "num_warps": warps}


def _tile(rows: int, fan_in: int, width: int) -> dict[str, int]:
    # 128 rows read weights half as often; few rows would leave a part of the GPU without work.
    tall, lanes = 128 if rows >= 128 * 128 and width <= 384 else 64, 64 if width <= 192 else 128
    depth, stages = (32, 4) if fan_in <= 256 or width > 384 else (64, 3)
    tile = {"CHUNKS": -(-width // lanes), "LANES": lanes, "ROWS": tall, "DEPTH": depth, "STAGES": stages}
    # More threads than lanes: others read vectors of columns otherwise than sums lie.
    return {**tile, "num_warps": tall * lanes // 1024 if lanes == 64 else 8}


@torch.no_grad()
def rounded_weights(weights: list[Float[Tensor, "N ?K ?M"]]) -> list[Float[Tensor, "N ?K_padded ?M_padded"]]:
    """Return weights in bfloat16, padded to whole 16 bytes in each dim, all by one kernel of compiled code.

    Tensor cores are fast with such rows: 315 inputs take three times as long as 320.
    """
    padded = [functional.pad(own, (0, -own.shape[-1] % 8, 0, -own.shape[-2] % 8)) for own in weights]
    flat = torch.cat([own.reshape(-1) for own in padded]).to(torch.bfloat16)
    parts = zip(flat.split([own.numel() for own in padded]), padded, strict=True)
    return [part.view_as(own) for part, own in parts]


def _padded(features: Tensor, columns: int, dtype: torch.dtype) -> Tensor:
    features = features.to(dtype)
    return functional.pad(features, (0, columns)) if columns else features
