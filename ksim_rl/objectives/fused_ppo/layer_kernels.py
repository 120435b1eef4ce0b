"""The Triton kernels that run one layer of both networks at a time, for networks of any depth.

They serve where the chained kernels of `mlp_kernels` do not fit. A layer leaves its outputs, and the slopes of its
activation where the gradient of the layer's outputs is written later; products are as in `mlp_kernels`.

`fan_in` and `fan_out` are a layer's padded widths, `..._at` first columns or elements; all are multiples of 16.
"""

import triton
import triton.language as tl

from ksim_rl.objectives.fused_ppo.loss_kernels import MASK, policy_gradient, value_gradient
from ksim_rl.objectives.fused_ppo.mlp_kernels import activate, operand, slope_of


@triton.jit
def _product(
    left, right, keep, inside, length, step, acc, DEPTH: tl.constexpr, STAGES: tl.constexpr
):
    # Rows of `left` are contiguous; elements of a column of `right` are `step` apart.
    place = tl.arange(0, DEPTH)
    for first in tl.range(0, length, DEPTH, num_stages=STAGES):  # pyright: ignore[reportGeneralTypeIssues]
        at = first + place
        row = tl.load(left + at[None, :], mask=keep & (at < length)[None, :], other=0.0)
        column = tl.load(
            right + at[:, None] * step, mask=inside & (at < length)[:, None], other=0.0
        )
        acc = tl.dot(row, column, acc)
    return acc


@triton.jit
def _linear(
    left, weights, bias, row, keep, fan_in,
    BLOCK: tl.constexpr, OUT: tl.constexpr, DEPTH: tl.constexpr, STAGES: tl.constexpr,
):  # fmt: skip
    # The outputs whose weights are in these rows [OUT], all of which exist.
    right = weights + row[None, :] * fan_in
    acc = tl.zeros((BLOCK, OUT), dtype=tl.float32) + tl.load(bias + row)[None, :]
    return _product(left, right, keep, (row >= 0)[None, :], fan_in, 1, acc, DEPTH, STAGES)


@triton.jit
def layer(
    inputs, slopes, weights, biases,
    num_rows, width, length, read_at, slope_at, output_at,
    FORWARD: tl.constexpr, NUM_PADDED: tl.constexpr,
    INPUTS: tl.constexpr, GRADIENTS: tl.constexpr, ACTIVATION: tl.constexpr, TF32: tl.constexpr,
    BLOCK: tl.constexpr, TILE: tl.constexpr, DEPTH: tl.constexpr, TILE_STAGES: tl.constexpr,
):  # fmt: skip
    """Compute TILE of `width` hidden units for BLOCK rows, FORWARD or back: program (i, j, n) is of network n.

    Forward, units are sums over `length` columns of `inputs` [2, num_rows, INPUTS] from `read_at` on, with the layer's
    weights; they go to `output_at`, and their slopes to `slope_at` in `slopes` [2, num_rows, GRADIENTS]. Back,
    gradients are sums over columns of `slopes`, with the next layer's weights; they take the place of the slopes.
    """
    block = tl.program_id(0)
    # 64 bits: the places of the second network can exceed 2^31.
    network = tl.program_id(2).to(tl.int64)
    rows = block * BLOCK + tl.arange(0, BLOCK)
    column = tl.program_id(1) * TILE + tl.arange(0, TILE)
    inside = (column < width)[None, :]
    keep = (rows < num_rows)[:, None]
    input_rows = inputs + network * num_rows * INPUTS + rows[:, None] * INPUTS
    slope_rows = slopes + network * num_rows * GRADIENTS + rows[:, None] * GRADIENTS
    slope_to = slope_rows + (slope_at + column[None, :])
    weights += network * NUM_PADDED
    dtype = slopes.dtype.element_ty
    acc = tl.zeros((BLOCK, TILE), dtype=tl.float32)
    if FORWARD:
        # Weights are [outputs, inputs]: forward, a column of the product is a row of them.
        right = weights + column[None, :] * length
        acc = _product(
            input_rows + read_at, right, keep, inside, length, 1, acc, DEPTH, TILE_STAGES
        )
        value = (
            acc
            + tl.load(biases + network * NUM_PADDED + column, mask=column < width, other=0.0)[
                None, :
            ]
        )
        hidden = activate(value, ACTIVATION)
        # The slope of SiLU needs its input, which is gone once the output is stored.
        if ACTIVATION == 3:
            gate = tl.sigmoid(value)
            slope = gate + hidden * (1.0 - gate)
        else:
            slope = slope_of(hidden, ACTIVATION)
        tl.store(
            input_rows + (output_at + column[None, :]),
            operand(hidden, dtype, TF32),
            mask=keep & inside,
        )
        tl.store(slope_to, slope.to(dtype), mask=keep & inside)
    else:
        # Back, the same weights are read across: elements of a column are a row apart.
        right = weights + column[None, :]
        acc = _product(
            slope_rows + read_at, right, keep, inside, length, width, acc, DEPTH, TILE_STAGES
        )
        gradient = acc * tl.load(slope_to, mask=keep & inside, other=0.0).to(tl.float32)
        tl.store(slope_to, operand(gradient, dtype, TF32), mask=keep & inside)


@triton.jit
def output_gradients(
    records, order, inputs, slopes, weights, biases, block_partials, image_of, nodes,
    num_rows, fan_in, input_at, slope_at, log_range,
    log_ratio_low, log_ratio_high, clip_value, entropy_coeff, critic_coeff, symmetry_coeff,
    NUM_PADDED: tl.constexpr, NUM_STATISTICS: tl.constexpr,
    RECORD: tl.constexpr, INPUTS: tl.constexpr, GRADIENTS: tl.constexpr, ACTIONS: tl.constexpr, OUT: tl.constexpr,
    LOG_STD: tl.constexpr, MIN_STD: tl.constexpr, STATE_STD: tl.constexpr, NODES: tl.constexpr, MIRROR: tl.constexpr,
    CLIP_VALUE: tl.constexpr, TF32: tl.constexpr, BLOCK: tl.constexpr, DEPTH: tl.constexpr, TILE_STAGES: tl.constexpr,
):  # fmt: skip
    """Run BLOCK rows through the last layer and the loss: program (i, n) is of network n (0: actor, 1: critic).

    Gradients at the outputs go to `slopes` [2, num_rows, GRADIENTS] from `slope_at` on, the gradient of the std and
    statistics to `block_partials`, as in `minibatch_gradients`. Weights and biases are the last layer's, NUM_PADDED
    apart. With MIRROR the second half of the rows, images of the first half, has the mirror loss only; `image_of` [OUT]
    has the source of each mirrored action, counted from 1, times its sign.
    """
    block = tl.program_id(0)
    network = tl.program_id(1)
    wide = network.to(tl.int64)
    rows = block * BLOCK + tl.arange(0, BLOCK)
    output = tl.arange(0, OUT)
    valid = rows < num_rows
    keep = valid[:, None]
    weights += network * NUM_PADDED
    biases += network * NUM_PADDED
    inputs += wide * num_rows * INPUTS + input_at
    d_std_at = block_partials + (block * 2 + network) * (OUT + NUM_STATISTICS)
    statistics = d_std_at + OUT
    dtype = slopes.dtype.element_ty
    slope_rows = slopes + wide * num_rows * GRADIENTS + (rows[:, None] * GRADIENTS + slope_at)
    # The last hidden layer of these rows.
    left = inputs + rows[:, None] * INPUTS
    out = _linear(left, weights, biases, output, keep, fan_in, BLOCK, OUT, DEPTH, TILE_STAGES)
    record = records + tl.load(order + rows, mask=valid, other=0).to(tl.int64) * RECORD
    # Which rows have a PPO loss; images have the mirror loss only.
    judged = valid
    if MIRROR:
        judged = rows < num_rows // 2
    if network == 0:
        if STATE_STD:
            raw_std = _linear(
                left, weights, biases, OUT + output, keep, fan_in, BLOCK, OUT, DEPTH, TILE_STAGES
            )
        else:
            raw_std = tl.load(
                biases + OUT + output, mask=output < ACTIONS, other=0.0 if LOG_STD else 1.0
            )[None, :]
        d_out, d_std = policy_gradient(
            out, raw_std, record, judged, d_std_at, statistics, log_ratio_low, log_ratio_high, entropy_coeff,
            nodes, log_range, ACTIONS, OUT, LOG_STD, MIN_STD, STATE_STD, NODES
        )  # fmt: skip
        if STATE_STD:
            tl.store(slope_rows + (OUT + output[None, :]), operand(d_std, dtype, TF32), mask=keep)
        if MIRROR:
            # A mirror map is its own inverse, so that both of a pair have the same gradient: at the outputs of the
            # one, against the image of the other's outputs. The image of outputs comes from permuted rows of weights.
            other = inputs + ((rows + num_rows // 2) % num_rows)[:, None] * INPUTS
            signed = tl.load(image_of + output)
            source = tl.abs(signed) - 1
            image = _linear(
                other, weights, biases, source, keep, fan_in, BLOCK, OUT, DEPTH, TILE_STAGES
            )
            image = tl.where(signed > 0, image, -image)
            counts = tl.load(record + (3 * OUT + MASK), mask=valid, other=0.0)[:, None] > 0.0
            gap = tl.where(counts & (output < ACTIONS)[None, :], out - image, 0.0)
            d_out += (2.0 * symmetry_coeff / ACTIONS) * gap
            tl.store(statistics + 5, 0.5 * symmetry_coeff / ACTIONS * tl.sum(gap * gap))
    else:
        d_out = value_gradient(
            out, record, judged, statistics, clip_value, critic_coeff, OUT, CLIP_VALUE
        )
    tl.store(slope_rows + output[None, :], operand(d_out, dtype, TF32), mask=keep)
