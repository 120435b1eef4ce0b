"""This module has the Triton kernels that add a bias, normalize rows, and apply an activation, forward and back.

A program takes some rows of one of N networks as a whole, in float32. Sums over rows are left in parts, one of each
program, and added up in one order: the same numbers each time.
"""

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

# In the order in which the kernels number them, from 1; 0 is none.
ACTIVATIONS = (nn.ReLU, nn.SiLU)
# Elements that a program holds at a time, forward and back, and how many rows it takes in all on the way back.
TILE, TILE_BACK, ROWS_BACK = 4096, 2048, 32


@triton.jit
def _standardized(
    features, bias, row, num_rows, width, EPS: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr
):
    # Also returned: one over the standard deviations, the places of the elements, and which of them exist.
    column = tl.arange(0, LANES)
    inside = column < width
    keep = (row < num_rows)[:, None] & inside[None, :]
    at = row[:, None] * width + column[None, :]
    value = tl.load(features + at, mask=keep, other=0.0).to(tl.float32)
    value += tl.load(bias + column, mask=inside, other=0.0)[None, :]
    error = tl.where(inside[None, :], value - (tl.sum(value, 1) / width)[:, None], 0.0)
    scale = 1.0 / tl.sqrt(tl.sum(error * error, 1) / width + EPS)
    return error * scale[:, None], scale, at, keep


@triton.jit
def normalize_rows(
    features,
    bias,
    gain,
    offset,
    out,
    num_rows,
    width,
    EPS: tl.constexpr,
    ACTIVATION: tl.constexpr,
    ROWS: tl.constexpr,
    LANES: tl.constexpr,
):
    """Write activation(gain * standardized(features + bias) + offset) of ROWS rows: program (i, n) is of network n."""
    network = tl.program_id(1)
    first = network.to(tl.int64) * num_rows * width
    own = network * width + tl.arange(0, LANES)
    inside = tl.arange(0, LANES) < width
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    unit, _, at, keep = _standardized(
        features + first, bias + network * width, row, num_rows, width, EPS, ROWS, LANES
    )
    value = unit * tl.load(gain + own, mask=inside, other=0.0)[None, :]
    value += tl.load(offset + own, mask=inside, other=0.0)[None, :]
    if ACTIVATION == 1:
        value = tl.maximum(value, 0.0)
    if ACTIVATION == 2:
        value = value * tl.sigmoid(value)
    tl.store(out + first + at, value.to(out.dtype.element_ty), mask=keep)


@triton.jit
def normalize_rows_back(
    d_out,
    features,
    bias,
    gain,
    offset,
    d_features,
    partials,
    num_rows,
    width,
    EPS: tl.constexpr,
    ACTIVATION: tl.constexpr,
    WEIGHTS: tl.constexpr,
    STEPS: tl.constexpr,
    ROWS: tl.constexpr,
    LANES: tl.constexpr,
):
    """Write the gradient at the features of `STEPS * ROWS` rows, and with WEIGHTS the sums of those of the weights.

    `partials` [N, programs, 3, width] get the sums of bias, gain and offset.
    """
    program, network = tl.program_id(0), tl.program_id(1)
    first = network.to(tl.int64) * num_rows * width
    column = tl.arange(0, LANES)
    inside = column < width
    scales = tl.load(gain + network * width + column, mask=inside, other=0.0)[None, :]
    offsets = tl.load(offset + network * width + column, mask=inside, other=0.0)[None, :]
    d_bias = tl.zeros((ROWS, LANES), dtype=tl.float32)
    d_gain = tl.zeros((ROWS, LANES), dtype=tl.float32)
    d_offset = tl.zeros((ROWS, LANES), dtype=tl.float32)
    # Loads run ahead of the sums.
    for step in tl.range(0, STEPS, num_stages=3):
        row = (program * STEPS + step) * ROWS + tl.arange(0, ROWS)
        unit, scale, at, keep = _standardized(
            features + first, bias + network * width, row, num_rows, width, EPS, ROWS, LANES
        )
        slope = tl.load(d_out + first + at, mask=keep, other=0.0).to(tl.float32)
        value = unit * scales + offsets
        if ACTIVATION == 1:
            slope = tl.where(value > 0.0, slope, 0.0)
        if ACTIVATION == 2:
            share = tl.sigmoid(value)
            slope *= share * (1.0 + value * (1.0 - share))
        if WEIGHTS:
            d_gain += slope * unit
            d_offset += slope
        slope *= scales
        mean = tl.sum(slope, 1) / width
        along = tl.sum(slope * unit, 1) / width
        slope = (slope - mean[:, None] - unit * along[:, None]) * scale[:, None]
        tl.store(d_features + first + at, slope.to(d_features.dtype.element_ty), mask=keep)
        if WEIGHTS:
            d_bias += slope
    if WEIGHTS:
        part = partials + (network * tl.num_programs(0) + program) * 3 * width + column
        tl.store(part, tl.sum(d_bias, 0), mask=inside)
        tl.store(part + width, tl.sum(d_gain, 0), mask=inside)
        tl.store(part + 2 * width, tl.sum(d_offset, 0), mask=inside)


def _tile(width: int, elements: int) -> dict[str, Any]:
    lanes = triton.next_power_of_2(width)
    # No more rows than a program takes.
    return {"LANES": lanes, "ROWS": min(max(elements // lanes, 1), ROWS_BACK), "num_warps": 8}


# Operators, since compiled code calls these without looking inside.
@torch.library.custom_op("ksim_rl::normalized", mutates_args=())
def normalized(
    features: Tensor, bias: Tensor, gain: Tensor, offset: Tensor, eps: float, activation: int
) -> Tensor:
    """Add the bias, normalize rows (Ba et al., arXiv 1607.06450), scale, add the offset, and apply an activation.

    The features [N, B, L] keep their dtype. Bias, gain and offset are float32 with N * L elements; `activation` counts
    those of `ACTIVATIONS` from 1, and 0 is none. Gradients are the same bits each time.
    """
    features = features.contiguous()
    (networks, rows, width), tile = features.shape, _tile(features.shape[-1], TILE)
    out = torch.empty_like(features)
    launch: Any = normalize_rows[triton.cdiv(rows, tile["ROWS"]), networks]
    launch(features, bias, gain, offset, out, rows, width, eps, activation, **tile)
    return out


@torch.library.custom_op("ksim_rl::normalized_back", mutates_args=())
def _back(
    d_out: Tensor,
    features: Tensor,
    bias: Tensor,
    gain: Tensor,
    offset: Tensor,
    eps: float,
    activation: int,
    weights: bool,
) -> tuple[Tensor, Tensor]:
    d_out, features, tile = d_out.contiguous(), features.contiguous(), _tile(features.shape[-1], TILE_BACK)
    d_features, partials = _like_back(features, weights)
    networks, rows, width = features.shape
    launch: Any = normalize_rows_back[triton.cdiv(rows, ROWS_BACK), networks]
    launch(
        *(d_out, features, bias, gain, offset, d_features, partials, rows, width, eps, activation, weights),
        STEPS=ROWS_BACK // tile["ROWS"],
        **tile,
    )
    return d_features, partials


def _like(features: Tensor) -> Tensor:
    return torch.empty_like(features, memory_format=torch.contiguous_format)


def _like_back(features: Tensor, weights: bool) -> tuple[Tensor, Tensor]:
    networks, rows, width = features.shape
    programs = triton.cdiv(rows, ROWS_BACK) if weights else 0
    return _like(features), features.new_empty(networks, programs, 3, width, dtype=torch.float32)


normalized.register_fake(lambda features, *_: _like(features))
_back.register_fake(lambda d_out, features, *given: _like_back(features, given[-1]))


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])
    ctx.options = inputs[4:]


def _gradients(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, ...]:
    weights = ctx.saved_tensors[1:]
    learns = any(ctx.needs_input_grad[1:4])
    d_features, partials = _back(d_out, *ctx.saved_tensors, *ctx.options, learns)
    sums = partials.sum(1).unbind(1)
    of_weights = [d_weight.view_as(weight) for d_weight, weight in zip(sums, weights, strict=True)]
    return d_features, *(of_weights if learns else (None,) * 3), None, None


normalized.register_autograd(_gradients, setup_context=_save)
