"""The Triton kernels that run a whole MLP, forward and back, for a block of env states at a time.

The widest hidden layer never exists as a whole: its columns are computed in chunks, and each chunk is multiplied into
the next layer directly. Products take the weights' dtype (bfloat16, or float32, as TF32 on a GPU), sums float32.

`docs/fused_ppo.md` has a diagram of the memory and derives the gradients. D env states are in the dataset, B in the
minibatch; OBS and OUT are the padded widths of observation and outputs, H1 to H3 those between, and ACTIONS
of the outputs are used.
"""

import triton
import triton.language as tl

from ksim_rl.objectives.fused_ppo.loss_kernels import policy_gradient, value_gradient


@triton.jit
def operand(value, dtype, TF32: tl.constexpr):
    """Return `value` as products take it; with TF32 rounded to 11 significant bits, as `as_tf32` does."""
    if TF32:
        # Half of the 13 bits that are cut off is added first, which rounds to the nearest.
        bits = value.to(tl.int32, bitcast=True)
        rounded = ((bits + 0x1000) & -0x2000).to(tl.float32, bitcast=True)
        # NaN stays NaN, where the addition could carry into its sign.
        value = tl.where(value == value, rounded, value)
    return value.to(dtype)


@triton.jit
def activate(value, ACTIVATION: tl.constexpr):
    """Return the activation at `value`."""
    if ACTIVATION == 0:
        value = tl.where(value > 0.0, value, tl.exp(value) - 1.0)
    elif ACTIVATION == 1:
        value = tl.maximum(value, 0.0)
    elif ACTIVATION == 2:
        value = 2.0 * tl.sigmoid(2.0 * value) - 1.0
    else:
        value = value * tl.sigmoid(value)
    return value


@triton.jit
def slope_of(value, ACTIVATION: tl.constexpr):
    """Return the slope of the activation whose output is `value`; SiLU has none, since two inputs have one output."""
    if ACTIVATION == 0:
        slope = tl.where(value > 0.0, 1.0, value + 1.0)
    elif ACTIVATION == 1:
        slope = tl.where(value > 0.0, 1.0, 0.0)
    else:
        slope = 1.0 - value * value
    return slope


@triton.jit
def read_rows(
    source, row, column, keep, mean, var, eps, like, WIDTH: tl.constexpr, NORMALIZED: tl.constexpr, TF32: tl.constexpr
):  # fmt: skip
    """Return columns of rows of `source` [D, WIDTH], normalized or not, in the dtype of `like`, for products."""
    used = column < WIDTH
    value = tl.load(source + (row * WIDTH + column), mask=keep & used, other=0.0)
    if NORMALIZED:
        # Normalized in float32, before the cast to the dtype of the products.
        shift = tl.load(mean + column, mask=used, other=0.0)
        value = (value - shift) / tl.sqrt(tl.load(var + column, mask=used, other=1.0) + eps)
    return operand(value, like.dtype.element_ty, TF32)


@triton.jit
def _outputs(
    seen, rows, keep, mean, var, eps, weights, biases, inputs, input_rows,
    WIDTH: tl.constexpr, NORMALIZED: tl.constexpr, OBS: tl.constexpr, HEAD: tl.constexpr, REST: tl.constexpr,
    H1: tl.constexpr, H2: tl.constexpr, H3: tl.constexpr, OUT: tl.constexpr,
    CHUNK: tl.constexpr, STAGES: tl.constexpr, ACTIVATION: tl.constexpr, TF32: tl.constexpr, STORE: tl.constexpr,
):  # fmt: skip
    """Return the outputs [BLOCK, OUT] for `rows` of `seen` [D, WIDTH]; STORE keeps all but the first hidden layer."""
    BLOCK: tl.constexpr = rows.shape[0]
    SECOND_AT: tl.constexpr = H1 * OBS
    THIRD_AT: tl.constexpr = SECOND_AT + H2 * H1
    OUT_AT: tl.constexpr = THIRD_AT + H3 * H2
    dtype = weights.dtype.element_ty
    head_column = tl.arange(0, HEAD)
    column = tl.arange(0, CHUNK)
    column2 = tl.arange(0, H2)
    output = tl.arange(0, OUT)
    at = rows[:, None]
    # Observations are read as one or two powers of two of columns: a single one would be mostly padding.
    observed = read_rows(
        seen, at, head_column, keep, mean, var, eps, weights, WIDTH, NORMALIZED, TF32
    )
    if STORE:
        tl.store(inputs + (input_rows + head_column), observed, mask=keep)
    if REST:
        rest_column = HEAD + tl.arange(0, REST)
        rest = read_rows(
            seen, at, rest_column, keep, mean, var, eps, weights, WIDTH, NORMALIZED, TF32
        )
        if STORE:
            tl.store(inputs + (input_rows + rest_column), rest, mask=keep)
    acc = tl.zeros((BLOCK, H2), dtype=tl.float32)
    # Biases are loaded a chunk ahead: each thread would copy the present chunk's to shared memory, like weights.
    bias = tl.load(biases + column)
    for first in tl.range(0, H1, CHUNK, num_stages=STAGES):
        # A chunk of the first hidden layer is computed, activated, and directly multiplied into the second.
        row = (first + column)[None, :] * OBS
        hidden = tl.dot(observed, tl.load(weights + (row + head_column[:, None])))
        if REST:
            hidden = tl.dot(rest, tl.load(weights + (row + rest_column[:, None])), hidden)
        weight2 = tl.load(weights + (SECOND_AT + column2[None, :] * H1 + (first + column)[:, None]))
        hidden += bias[None, :]
        bias = tl.load(biases + (first + CHUNK) % H1 + column)
        hidden = operand(activate(hidden, ACTIVATION), dtype, TF32)
        acc = tl.dot(hidden, weight2, acc)
    # The second hidden layer is kept as a whole: each chunk of the third one needs all of it.
    second = activate(acc + tl.load(biases + H1 + column2)[None, :], ACTIVATION)
    second = operand(second, dtype, TF32)
    if STORE:
        tl.store(inputs + (input_rows + (OBS + column2[None, :])), second, mask=keep)
    out = tl.zeros((BLOCK, OUT), dtype=tl.float32)
    bias = tl.load(biases + H1 + H2 + column)
    for first in tl.range(0, H3, CHUNK, num_stages=STAGES):
        # Chunks of the third layer go straight into the outputs, in the same way.
        weight3 = tl.load(weights + (THIRD_AT + (first + column)[None, :] * H2 + column2[:, None]))
        weight4 = tl.load(weights + (OUT_AT + output[None, :] * H3 + (first + column)[:, None]))
        hidden = tl.dot(second, weight3) + bias[None, :]
        bias = tl.load(biases + H1 + H2 + (first + CHUNK) % H3 + column)
        hidden = operand(activate(hidden, ACTIVATION), dtype, TF32)
        if STORE:
            tl.store(
                inputs + (input_rows + (OBS + H2 + first + column[None, :])), hidden, mask=keep
            )
        out = tl.dot(hidden, weight4, out)
    return out + tl.load(biases + H1 + H2 + H3 + output)[None, :]


@triton.jit
def network_outputs(
    obs, places, count, mean, var, eps, weights, biases, outputs, num_rows,
    LISTED: tl.constexpr, WIDTH: tl.constexpr, NORMALIZED: tl.constexpr, COLUMNS: tl.constexpr,
    OBS: tl.constexpr, HEAD: tl.constexpr, REST: tl.constexpr,
    H1: tl.constexpr, H2: tl.constexpr, H3: tl.constexpr, OUT: tl.constexpr, BLOCK: tl.constexpr,
    CHUNK: tl.constexpr, STAGES: tl.constexpr, ACTIVATION: tl.constexpr, TF32: tl.constexpr,
):  # fmt: skip
    """Write a network's outputs for rows of `obs` [D, WIDTH] to `outputs` [D, COLUMNS]; LISTED, `count` to `places`."""
    rows = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if LISTED:
        # The number of rows is known on the device only; programs beyond it have nothing to do.
        num_rows = tl.load(count)
    if tl.program_id(0) * BLOCK >= num_rows:
        return
    valid = rows < num_rows
    out = _outputs(
        obs, rows, valid[:, None], mean, var, eps, weights, biases, outputs, rows, WIDTH, NORMALIZED, OBS, HEAD, REST,
        H1, H2, H3, OUT, CHUNK, STAGES, ACTIVATION, TF32, False
    )  # fmt: skip
    if LISTED:
        # Row i of the list is of the env state at `places[i]`.
        rows = tl.load(places + rows, mask=valid, other=0)
    column = tl.arange(0, OUT)[None, :]
    tl.store(
        outputs + (rows[:, None] * COLUMNS + column), out, mask=valid[:, None] & (column < COLUMNS)
    )


@triton.jit
def minibatch_gradients(
    obs, records, order, weights, biases, inputs, slopes, block_partials, num_rows, num_obs,
    log_ratio_low, log_ratio_high, clip_value, entropy_coeff, critic_coeff,
    NUM_PADDED: tl.constexpr, NUM_STATISTICS: tl.constexpr, RECORD: tl.constexpr, INPUTS: tl.constexpr,
    GRADIENTS: tl.constexpr, STORED: tl.constexpr, OBS: tl.constexpr, HEAD: tl.constexpr, REST: tl.constexpr,
    H1: tl.constexpr, H2: tl.constexpr, H3: tl.constexpr, ACTIONS: tl.constexpr, OUT: tl.constexpr,
    LOG_STD: tl.constexpr, MIN_STD: tl.constexpr, CLIP_VALUE: tl.constexpr, BLOCK: tl.constexpr,
    CHUNK: tl.constexpr, STAGES: tl.constexpr, ACTIVATION: tl.constexpr, TF32: tl.constexpr,
):  # fmt: skip
    """Run a block of a minibatch through one network, its loss, and back: all but the products for the weights.

    Program (i, n) takes BLOCK rows of the minibatch, the env states `order` [B], through network n (0: actor, 1:
    critic). It leaves what layers read [2, B, INPUTS] and the gradients of the sum of the losses at layer outputs [2,
    B, GRADIENTS], but not at the first hidden layer (see `lower_gradients`), and the block's part of the
    gradient of the std and to the statistics of the loss: [blocks, 2, OUT + NUM_STATISTICS]. Weights and biases are in
    padded form, [2, NUM_PADDED].
    """
    block = tl.program_id(0)
    network = tl.program_id(1)
    wide = network.to(tl.int64)
    SECOND_AT: tl.constexpr = H1 * OBS
    THIRD_AT: tl.constexpr = SECOND_AT + H2 * H1
    OUT_AT: tl.constexpr = THIRD_AT + H3 * H2
    column = tl.arange(0, CHUNK)
    column2 = tl.arange(0, H2)
    output = tl.arange(0, OUT)

    rows = block * BLOCK + tl.arange(0, BLOCK)
    valid = rows < num_rows
    keep = valid[:, None]
    # The minibatch is a list of env states: rows are gathered, and never copied together.
    index = tl.load(order + rows, mask=valid, other=0).to(tl.int32)
    weights += network * NUM_PADDED
    biases += network * NUM_PADDED
    obs += wide * num_obs * STORED
    inputs += wide * num_rows * INPUTS
    slopes += wide * num_rows * GRADIENTS
    d_std_at = block_partials + (block * 2 + network) * (OUT + NUM_STATISTICS)
    statistics = d_std_at + OUT
    input_rows = rows[:, None] * INPUTS
    gradient_rows = rows[:, None] * GRADIENTS

    dtype = slopes.dtype.element_ty
    out = _outputs(
        obs, index, keep, None, None, 0.0, weights, biases, inputs, input_rows, STORED, False, OBS, HEAD, REST,
        H1, H2, H3, OUT, CHUNK, STAGES, ACTIVATION, TF32, True
    )  # fmt: skip

    record = records + index.to(tl.int64) * RECORD
    if network == 0:
        # The std follows the biases; padding has the neutral value 1, or 0 as a logarithm.
        raw_std = tl.load(
            biases + H1 + H2 + H3 + OUT + output,
            mask=output < ACTIONS,
            other=0.0 if LOG_STD else 1.0,
        )[None, :]
        d_out, _ = policy_gradient(
            out, raw_std, record, valid, d_std_at, statistics, log_ratio_low, log_ratio_high, entropy_coeff,
            None, 0.0, ACTIONS, OUT, LOG_STD, MIN_STD, False, 0
        )  # fmt: skip
    else:
        d_out = value_gradient(
            out, record, valid, statistics, clip_value, critic_coeff, OUT, CLIP_VALUE
        )
    # Gradients of the outputs, from here on the first factor of the products back.
    d_out = operand(d_out, dtype, TF32)
    tl.store(slopes + (gradient_rows + (H2 + H3 + output[None, :])), d_out, mask=keep)
    # From here on threads read hidden layers that others of the block have written.
    tl.debug_barrier()
    acc = tl.zeros((BLOCK, H2), dtype=tl.float32)
    for first in tl.range(0, H3, CHUNK, num_stages=STAGES):
        # Back through the third layer chunk by chunk; `acc` collects the gradient of the second.
        weight4 = tl.load(weights + (OUT_AT + output[:, None] * H3 + (first + column)[None, :]))
        weight3 = tl.load(weights + (THIRD_AT + (first + column)[:, None] * H2 + column2[None, :]))
        hidden = tl.load(
            inputs + (input_rows + (OBS + H2 + first + column[None, :])), mask=keep, other=0.0
        )
        slope = tl.dot(d_out, weight4) * slope_of(hidden.to(tl.float32), ACTIVATION)
        slope = operand(slope, dtype, TF32)
        tl.store(slopes + (gradient_rows + (H2 + first + column[None, :])), slope, mask=keep)
        acc = tl.dot(slope, weight3, acc)
    middle = tl.load(inputs + (input_rows + (OBS + column2[None, :])), mask=keep, other=0.0)
    second = acc * slope_of(middle.to(tl.float32), ACTIVATION)
    second = operand(second, dtype, TF32)
    tl.store(slopes + (gradient_rows + column2[None, :]), second, mask=keep)


@triton.jit
def lower_gradients(
    inputs, slopes, weights, biases, weight_partials, num_rows,
    NUM_PADDED: tl.constexpr, NUM_WEIGHTS: tl.constexpr, INPUTS: tl.constexpr, GRADIENTS: tl.constexpr,
    OBS: tl.constexpr, HEAD: tl.constexpr, REST: tl.constexpr, H1: tl.constexpr, H2: tl.constexpr, ROWS: tl.constexpr,
    LOWER: tl.constexpr, LOWER_DEPTH: tl.constexpr, LOWER_STAGES: tl.constexpr,
    ACTIVATION: tl.constexpr, TF32: tl.constexpr,
):  # fmt: skip
    """Sum the gradients of both layers around the first hidden one, which is computed here again.

    Program (i, s, n) has LOWER of its elements, whose weights stay in shared memory, over the ROWS of split s, in
    network n; neither they nor the gradients at them are ever in memory. It writes to the places of its split, as
    `weight_gradients` does, all but the biases of the second layer. All is transposed: the result here is the
    first factor of the next product, as which it stays in registers. Observations are HEAD columns and REST more, both
    powers of two, which are fewer than OBS.
    """
    split = tl.program_id(1)
    network = tl.program_id(2)
    SECOND_AT: tl.constexpr = H1 * OBS
    # Transposed: elements of the hidden layer are rows, env states columns.
    element = (tl.program_id(0) * LOWER + tl.arange(0, LOWER))[:, None]
    head_column = tl.arange(0, HEAD)[None, :]
    column2 = tl.arange(0, H2)[None, :]
    inputs += network.to(tl.int64) * num_rows * INPUTS
    slopes += network.to(tl.int64) * num_rows * GRADIENTS
    weights += network * NUM_PADDED
    weight_partials += (split * 2 + network).to(tl.int64) * NUM_PADDED
    weight1 = tl.load(weights + (element * OBS + head_column))
    weight2 = tl.load(weights + (SECOND_AT + column2 * H1 + element))
    bias = tl.load(biases + network * NUM_PADDED + element)
    d_weight1 = tl.zeros((LOWER, HEAD), dtype=tl.float32)
    if REST:
        rest_column = HEAD + tl.arange(0, REST)[None, :]
        weight_rest = tl.load(weights + (element * OBS + rest_column))
        d_weight_rest = tl.zeros((LOWER, REST), dtype=tl.float32)
    d_weight2 = tl.zeros((LOWER, H2), dtype=tl.float32)
    d_bias = tl.zeros((LOWER,), dtype=tl.float32)
    for first in tl.range(0, ROWS, LOWER_DEPTH, num_stages=LOWER_STAGES):
        rows = (split * ROWS + first + tl.arange(0, LOWER_DEPTH))[:, None]
        observed = tl.load(inputs + (rows * INPUTS + head_column), mask=rows < num_rows, other=0.0)
        # Gradients at the second hidden layer, which `minibatch_gradients` has left.
        above = tl.load(slopes + (rows * GRADIENTS + column2), mask=rows < num_rows, other=0.0)
        hidden = tl.dot(weight1, tl.trans(observed))
        if REST:
            rest = tl.load(inputs + (rows * INPUTS + rest_column), mask=rows < num_rows, other=0.0)
            hidden = tl.dot(weight_rest, tl.trans(rest), hidden)
        # Forward again for these elements, then back to them through the second layer's weights.
        hidden = operand(activate(hidden + bias, ACTIVATION), observed.dtype, TF32)
        slope = tl.dot(weight2, tl.trans(above))
        # A GPU computes the slopes of the activation meanwhile: nothing waits for a product that adds up.
        d_weight2 = tl.dot(hidden, above, d_weight2)
        slope = operand(slope * slope_of(hidden.to(tl.float32), ACTIVATION), observed.dtype, TF32)
        d_weight1 = tl.dot(slope, observed, d_weight1)
        if REST:
            d_weight_rest = tl.dot(slope, rest, d_weight_rest)
        d_bias += tl.sum(slope.to(tl.float32), 1)
    tl.store(weight_partials + (element * OBS + head_column), d_weight1)
    if REST:
        tl.store(weight_partials + (element * OBS + rest_column), d_weight_rest)
    tl.store(weight_partials + (SECOND_AT + column2 * H1 + element), d_weight2)
    tl.store(weight_partials + NUM_WEIGHTS + element, d_bias[:, None])


@triton.jit
def weight_gradients(
    tiles, inputs, slopes, weight_partials, num_rows,
    NUM_PADDED: tl.constexpr, INPUTS: tl.constexpr, GRADIENTS: tl.constexpr,
    ROWS: tl.constexpr, TILE: tl.constexpr, DEPTH: tl.constexpr, TILE_STAGES: tl.constexpr,
):  # fmt: skip
    """Multiply gradients by layer inputs: program (i, s) computes tile i of `FusedLayout.weight_tiles` over split s.

    A split has ROWS rows of the minibatch. Of several splits each writes its own sum, [splits, 2, NUM_PADDED], so that
    the result does not depend on who is first. Biases have an input of one.
    """
    # The columns of `FusedLayout.weight_tiles`. Widths are multiples of 16, which allows wide loads.
    tile = tiles + tl.program_id(0) * 8
    split = tl.program_id(1)
    network = tl.load(tile)
    first_input = tl.multiple_of(tl.load(tile + 1), 16)
    first_gradient = tl.multiple_of(tl.load(tile + 2), 16)
    place = tl.load(tile + 3)
    stride = tl.load(tile + 4)
    input_columns = tl.multiple_of(tl.load(tile + 5), 16)
    gradient_columns = tl.multiple_of(tl.load(tile + 6), 16)
    bias = tl.load(tile + 7)
    row = tl.arange(0, DEPTH)
    lane = tl.arange(0, TILE)
    column = lane[None, :]
    # Columns past the tile's own are not read: in a network's last tiles these are most.
    reads = lane < input_columns
    inside = lane < gradient_columns
    inputs += network.to(tl.int64) * num_rows * INPUTS + first_input
    slopes += network.to(tl.int64) * num_rows * GRADIENTS + first_gradient
    acc = tl.zeros((TILE, TILE), dtype=tl.float32)
    # The smallest product that there is, of which one column is used: a separate sum over rows would take longer.
    sums = tl.zeros((TILE, 16), dtype=tl.float32)
    one = (tl.arange(0, 16)[None, :] == row[:, None] * 0).to(inputs.dtype.element_ty)
    for first in tl.range(0, ROWS, DEPTH, num_stages=TILE_STAGES):
        rows = (split * ROWS + first + row)[:, None]
        valid = rows < num_rows
        layer_input = tl.load(
            inputs + (rows * INPUTS + column), mask=valid & reads[None, :], other=0.0
        )
        gradient = tl.load(
            slopes + (rows * GRADIENTS + column), mask=valid & inside[None, :], other=0.0
        )
        acc = tl.dot(tl.trans(gradient), layer_input, acc)
        sums = tl.dot(tl.trans(gradient), one, sums)
    weight_partials += (split * 2 + network).to(tl.int64) * NUM_PADDED
    keep = inside[:, None] & reads[None, :]
    tl.store(weight_partials + place + (lane[:, None] * stride + column), acc, mask=keep)
    tl.store(weight_partials + bias + lane, tl.sum(sums, 1), mask=inside & (bias >= 0))
