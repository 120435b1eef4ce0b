"""Triton kernels that run a whole MLP, forward and back, for a block of env states at a time.

The widest hidden layer never exists as a whole: its columns are computed in chunks, and each chunk is multiplied into
the next layer at once. Products take the dtype of the weights (bfloat16, or float32 as TF32) and add up in float32.

Names: D env states in the dataset, B in the minibatch, L the padded width of an observation, H1, H2, H3 the hidden
widths, O the padded width of the outputs.
"""

import triton
import triton.language as tl

from ksim_rl.objectives.fused_ppo.loss_kernels import policy_gradient, value_gradient


@triton.jit
def _elu(z):
    return tl.where(z > 0.0, z, tl.exp(z) - 1.0)


@triton.jit
def _elu_slope(h):
    # From the output alone, so that the input of the ELU is never stored.
    return tl.where(h > 0.0, 1.0, h + 1.0)


@triton.jit
def _outputs(
    x,
    weights,
    biases,
    inputs,
    input_rows,
    keep,
    L: tl.constexpr,
    H1: tl.constexpr,
    H2: tl.constexpr,
    H3: tl.constexpr,
    O: tl.constexpr,  # noqa: E741
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    STAGES: tl.constexpr,
    STORE: tl.constexpr,
):
    """Return the outputs [BLOCK, O] for observations `x` [BLOCK, L]; STORE also keeps the hidden layers in `inputs`."""
    W2: tl.constexpr = H1 * L
    W3: tl.constexpr = W2 + H2 * H1
    W4: tl.constexpr = W3 + H3 * H2
    l = tl.arange(0, L)  # noqa: E741
    c = tl.arange(0, CHUNK)
    h2 = tl.arange(0, H2)
    o = tl.arange(0, O)
    acc = tl.zeros((BLOCK, H2), dtype=tl.float32)
    for first in tl.range(0, H1, CHUNK, num_stages=STAGES):
        w1 = tl.load(weights + ((first + c)[None, :] * L + l[:, None]))
        w2 = tl.load(weights + (W2 + h2[None, :] * H1 + (first + c)[:, None]))
        hidden = _elu(tl.dot(x, w1) + tl.load(biases + first + c)[None, :]).to(x.dtype)
        if STORE:
            tl.store(inputs + (input_rows + (L + first + c[None, :])), hidden, mask=keep)
        acc = tl.dot(hidden, w2, acc)
    second = _elu(acc + tl.load(biases + H1 + h2)[None, :]).to(x.dtype)
    if STORE:
        tl.store(inputs + (input_rows + (L + H1 + h2[None, :])), second, mask=keep)
    out = tl.zeros((BLOCK, O), dtype=tl.float32)
    for first in tl.range(0, H3, CHUNK, num_stages=STAGES):
        w3 = tl.load(weights + (W3 + (first + c)[None, :] * H2 + h2[:, None]))
        w4 = tl.load(weights + (W4 + o[None, :] * H3 + (first + c)[:, None]))
        hidden = _elu(tl.dot(second, w3) + tl.load(biases + H1 + H2 + first + c)[None, :]).to(x.dtype)
        if STORE:
            tl.store(inputs + (input_rows + (L + H1 + H2 + first + c[None, :])), hidden, mask=keep)
        out = tl.dot(hidden, w4, out)
    return out + tl.load(biases + H1 + H2 + H3 + o)[None, :]


@triton.jit
def state_values(
    obs,
    weights,
    biases,
    values,
    num_rows,
    L: tl.constexpr,
    H1: tl.constexpr,
    H2: tl.constexpr,
    H3: tl.constexpr,
    O: tl.constexpr,  # noqa: E741
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    STAGES: tl.constexpr,
):
    """Write the first output of a network for each row of `obs` [D, L] to `values` [D]."""
    rows = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    valid = rows < num_rows
    keep = valid[:, None]
    x = tl.load(obs + (rows[:, None] * L + tl.arange(0, L)[None, :]), mask=keep, other=0.0)
    out = _outputs(x, weights, biases, values, rows, keep, L, H1, H2, H3, O, BLOCK, CHUNK, STAGES, False)
    tl.store(values + rows, tl.sum(tl.where(tl.arange(0, O)[None, :] == 0, out, 0.0), 1), mask=valid)


@triton.jit
def minibatch_gradients(
    obs,
    records,
    order,
    weights,
    biases,
    inputs,
    gradients,
    partials,
    num_rows,
    num_obs,
    log_ratio_low,
    log_ratio_high,
    clip_value,
    entropy_coeff,
    critic_coeff,
    NUM_PADDED: tl.constexpr,
    NUM_BIASES: tl.constexpr,
    NUM_STATISTICS: tl.constexpr,
    RECORD: tl.constexpr,
    INPUTS: tl.constexpr,
    GRADIENTS: tl.constexpr,
    L: tl.constexpr,
    H1: tl.constexpr,
    H2: tl.constexpr,
    H3: tl.constexpr,
    A: tl.constexpr,
    O: tl.constexpr,  # noqa: E741
    LOG_STD: tl.constexpr,
    MIN_STD: tl.constexpr,
    CLIP_VALUE: tl.constexpr,
    BLOCK: tl.constexpr,
    CHUNK: tl.constexpr,
    STAGES: tl.constexpr,
):
    """Run a block of a minibatch through one network, its loss, and back: all but the products for the weights.

    Program (i, n) takes BLOCK rows of the minibatch through network n (0: actor, 1: critic). It leaves the inputs of
    all layers [2, B, INPUTS], the gradients of the sum of the losses at all layer outputs [2, B, GRADIENTS], and what
    the block adds to the gradients of biases and std and to the statistics of the loss: [blocks, 2, NUM_BIASES +
    NUM_STATISTICS].

    Args:
        obs: normalized observations [2, D, L].
        records: [D, RECORD]; see `loss_kernels`.
        order: the env states of the minibatch, [B].
        weights, biases: padded form, [2, NUM_PADDED].
    """
    block = tl.program_id(0)
    network = tl.program_id(1)
    wide = network.to(tl.int64)
    W2: tl.constexpr = H1 * L
    W3: tl.constexpr = W2 + H2 * H1
    W4: tl.constexpr = W3 + H3 * H2
    l = tl.arange(0, L)  # noqa: E741
    c = tl.arange(0, CHUNK)
    h2 = tl.arange(0, H2)
    o = tl.arange(0, O)

    rows = block * BLOCK + tl.arange(0, BLOCK)
    valid = rows < num_rows
    keep = valid[:, None]
    index = tl.load(order + rows, mask=valid, other=0).to(tl.int32)
    weights += network * NUM_PADDED
    biases += network * NUM_PADDED
    obs += wide * num_obs * L
    inputs += wide * num_rows * INPUTS
    gradients += wide * num_rows * GRADIENTS
    partials += (block * 2 + network) * (NUM_BIASES + NUM_STATISTICS)
    input_rows = rows[:, None] * INPUTS
    gradient_rows = rows[:, None] * GRADIENTS

    x = tl.load(obs + (index[:, None] * L + l[None, :]), mask=keep, other=0.0)
    tl.store(inputs + (input_rows + l[None, :]), x, mask=keep)
    out = _outputs(x, weights, biases, inputs, input_rows, keep, L, H1, H2, H3, O, BLOCK, CHUNK, STAGES, True)

    record = records + index.to(tl.int64) * RECORD
    d_std_at = partials + H1 + H2 + H3 + O
    statistics = partials + NUM_BIASES
    if network == 0:
        raw = tl.load(biases + H1 + H2 + H3 + O + o, mask=o < A, other=0.0 if LOG_STD else 1.0)
        d_out = policy_gradient(
            out, raw, record, valid, d_std_at, statistics, log_ratio_low, log_ratio_high, entropy_coeff,
            A, O, LOG_STD, MIN_STD,
        )  # fmt: skip
    else:
        d_out = value_gradient(out, record, valid, statistics, clip_value, critic_coeff, O, CLIP_VALUE)
        tl.store(d_std_at + o, tl.zeros((O,), dtype=tl.float32))

    tl.store(partials + H1 + H2 + H3 + o, tl.sum(d_out, 0))
    d_out = d_out.to(x.dtype)
    tl.store(gradients + (gradient_rows + (H1 + H2 + H3 + o[None, :])), d_out, mask=keep)
    # From here on threads read hidden layers that others of the block have written.
    tl.debug_barrier()
    acc = tl.zeros((BLOCK, H2), dtype=tl.float32)
    for first in tl.range(0, H3, CHUNK, num_stages=STAGES):
        w4 = tl.load(weights + (W4 + o[:, None] * H3 + (first + c)[None, :]))
        w3 = tl.load(weights + (W3 + (first + c)[:, None] * H2 + h2[None, :]))
        hidden = tl.load(inputs + (input_rows + (L + H1 + H2 + first + c[None, :])), mask=keep, other=0.0)
        slope = tl.dot(d_out, w4) * _elu_slope(hidden.to(tl.float32))
        tl.store(partials + H1 + H2 + first + c, tl.sum(slope, 0))
        slope = slope.to(x.dtype)
        tl.store(gradients + (gradient_rows + (H1 + H2 + first + c[None, :])), slope, mask=keep)
        acc = tl.dot(slope, w3, acc)
    middle = tl.load(inputs + (input_rows + (L + H1 + h2[None, :])), mask=keep, other=0.0)
    second = acc * _elu_slope(middle.to(tl.float32))
    tl.store(partials + H1 + h2, tl.sum(second, 0))
    second = second.to(x.dtype)
    tl.store(gradients + (gradient_rows + (H1 + h2[None, :])), second, mask=keep)
    for first in tl.range(0, H1, CHUNK, num_stages=STAGES):
        w2 = tl.load(weights + (W2 + h2[:, None] * H1 + (first + c)[None, :]))
        hidden = tl.load(inputs + (input_rows + (L + first + c[None, :])), mask=keep, other=0.0)
        slope = tl.dot(second, w2) * _elu_slope(hidden.to(tl.float32))
        tl.store(partials + first + c, tl.sum(slope, 0))
        tl.store(gradients + (gradient_rows + (first + c[None, :])), slope.to(x.dtype), mask=keep)


@triton.jit
def weight_gradients(
    tiles,
    inputs,
    gradients,
    partials,
    num_rows,
    NUM_WEIGHTS: tl.constexpr,
    INPUTS: tl.constexpr,
    GRADIENTS: tl.constexpr,
    ROWS: tl.constexpr,
    TILE: tl.constexpr,
    DEPTH: tl.constexpr,
    STAGES: tl.constexpr,
):
    """Multiply gradients by layer inputs: program (i, s) computes tile i of the weight gradients over split s.

    A split has ROWS rows of the minibatch. Of several splits each writes its own sum, [splits, 2, NUM_WEIGHTS], so
    that the result does not depend on who is first.

    Args:
        tiles: `FusedLayout.weight_tiles`.
    """
    tile = tiles + tl.program_id(0) * 8
    split = tl.program_id(1)
    network = tl.load(tile)
    first_input = tl.multiple_of(tl.load(tile + 1), 16)
    first_gradient = tl.multiple_of(tl.load(tile + 2), 16)
    place = tl.load(tile + 3)
    stride = tl.load(tile + 4)
    input_columns = tl.load(tile + 5)
    gradient_columns = tl.load(tile + 6)
    k = tl.arange(0, DEPTH)
    i = tl.arange(0, TILE)
    # Columns past the tile's own belong to the next layer or row: they are multiplied, and not stored.
    inputs += network.to(tl.int64) * num_rows * INPUTS + first_input
    gradients += network.to(tl.int64) * num_rows * GRADIENTS + first_gradient
    acc = tl.zeros((TILE, TILE), dtype=tl.float32)
    for first in tl.range(0, ROWS, DEPTH, num_stages=STAGES):
        rows = (split * ROWS + first + k)[:, None]
        layer_input = tl.load(inputs + (rows * INPUTS + i[None, :]), mask=rows < num_rows, other=0.0)
        gradient = tl.load(gradients + (rows * GRADIENTS + i[None, :]), mask=rows < num_rows, other=0.0)
        acc = tl.dot(tl.trans(gradient), layer_input, acc)
    at = (split * 2 + network).to(tl.int64) * NUM_WEIGHTS + place
    keep = (i[:, None] < gradient_columns) & (i[None, :] < input_columns)
    tl.store(partials + at + (i[:, None] * stride + i[None, :]), acc, mask=keep)
