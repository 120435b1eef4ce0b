"""The Triton kernels between a minibatch and the next: sums, statistics, learning rate, Adam.

The measurements of a gradient step are one row of `SUMMARY` columns.
"""

import triton
import triton.language as tl

from ksim_rl.objectives.fused_ppo.loss_kernels import HALF_LOG_2_PI
from ksim_rl.objectives.fused_ppo.mlp_kernels import operand

SUMMARY = (
    "loss_objective",
    "loss_critic",
    "entropy",
    "kl",
    "clip_fraction",
    "explained_variance",
    "loss",
    "learning_rate",
    "grad_norm",
    "skipped",
    "skipped_in_a_row",
    "loss_mirror",
)
# Kernels read globals only as constants of their own type.
LOSS = tl.constexpr(SUMMARY.index("loss"))
LEARNING_RATE = tl.constexpr(SUMMARY.index("learning_rate"))
GRAD_NORM = tl.constexpr(SUMMARY.index("grad_norm"))
SKIPPED = tl.constexpr(SUMMARY.index("skipped"))
SKIPPED_IN_A_ROW = tl.constexpr(SUMMARY.index("skipped_in_a_row"))
LOSS_MIRROR = tl.constexpr(SUMMARY.index("loss_mirror"))
# Behind it stands the share of all ranks' rows that took part: of this rank, and after the sum over ranks, of all.
SHARE = tl.constexpr(len(SUMMARY))
# As in TorchRL's explained variance: the resolution of float32.
EPS = tl.constexpr(1.1920929e-07)


@triton.jit
def _block_sums(
    partials, column, inside, WIDTH: tl.constexpr, BLOCKS: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    # Each row of the tile adds up its share of the blocks; the rows are added last, in a fixed order.
    sums = tl.zeros((ROWS, COLUMNS), dtype=tl.float32)
    for first in range(0, BLOCKS, ROWS):
        block = (first + tl.arange(0, ROWS))[:, None]
        # A block has two rows, one per network; this is the actor's.
        keep = (block < BLOCKS) & inside[None, :]
        sums += tl.load(partials + (block * 2 * WIDTH + column[None, :]), mask=keep, other=0.0)
    return tl.sum(sums, 0)


@triton.jit
def _merged(count, mean, squares, size, total, own):
    # With `size` more numbers, given by their sum and the sum of squares about their mean (Chan et al., 1979).
    share = size / tl.maximum(count + size, 1.0)
    gap = total / tl.maximum(size, 1.0) - mean
    return mean + gap * share, squares + own + gap * gap * count * share


@triton.jit
def _variance(count, mean, squares):
    number = tl.maximum(tl.sum(count), 1.0)
    gap = mean - tl.sum(count * mean) / number
    return tl.sum(squares + count * gap * gap) / number


@triton.jit
def _column(values, index: tl.constexpr, SIZE: tl.constexpr):
    return tl.sum(tl.where(tl.arange(0, SIZE) == index, values, 0.0))


@triton.jit
def _adapt(learning_rate, kl, desired_kl, bounds, ADAPTIVE: tl.constexpr):
    """Return the learning rate, after `adapt_learning_rate_` if it is ADAPTIVE."""
    rate = tl.load(learning_rate)
    if ADAPTIVE:  # comparisons with NaN are False
        slower = tl.maximum(rate / 1.5, tl.load(bounds))
        faster = tl.minimum(rate * 1.5, tl.load(bounds + 1))
        too_near = (kl < 0.5 * desired_kl) & (kl > 0.0)
        rate = tl.where(kl > 2.0 * desired_kl, slower, tl.where(too_near, faster, rate))
        tl.store(learning_rate, rate)
    return rate


@triton.jit
def sum_gradients(
    weight_partials, block_partials, gradients, squares, biases, learning_rate, summary, num_rows,
    critic_coeff, desired_kl, rate_bounds,
    RANKS: tl.constexpr, SPLITS: tl.constexpr, BLOCKS: tl.constexpr,
    NUM_PADDED: tl.constexpr, NUM_BIASES: tl.constexpr, NUM_STATISTICS: tl.constexpr,
    ACTIONS: tl.constexpr, OUT: tl.constexpr, LOG_STD: tl.constexpr, MIN_STD: tl.constexpr,
    STATE_STD: tl.constexpr, NODES: tl.constexpr, MIRROR: tl.constexpr, ADAPTIVE: tl.constexpr,
    SIZE: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Add up the sums of splits and blocks, divide by the number of rows of all ranks, and adapt the learning rate.

    The first programs take SIZE weights and biases each, and leave their gradients [2, NUM_PADDED] and the sum of their
    squares; two more take the std and the statistics of the policy's loss, and of the value's. That gradients are
    means of only a SHARE of the rows is left to who reads them, so that no program waits for the count.
    """
    PROGRAMS: tl.constexpr = (NUM_PADDED + SIZE - 1) // SIZE
    STD_AT: tl.constexpr = NUM_PADDED - OUT
    WIDTH: tl.constexpr = OUT + NUM_STATISTICS
    program = tl.program_id(0)
    divisor = num_rows * (1.0 * RANKS)
    if program < 2 * PROGRAMS:
        network = program // PROGRAMS
        at = (program % PROGRAMS) * SIZE + tl.arange(0, SIZE)
        # The std that is no output of a layer has its gradient from the policy's loss, in the branch below.
        kept = at < (NUM_PADDED if STATE_STD else STD_AT)
        total = tl.zeros((SIZE,), dtype=tl.float32)
        # In the order of the splits, so that the same sums have the same bits each time.
        for split in tl.static_range(SPLITS):
            place = (split * 2 + network) * NUM_PADDED + at
            total += tl.load(weight_partials + place, mask=kept, other=0.0)
        total = total / divisor
        tl.store(gradients + (network * NUM_PADDED + at), total, mask=kept)
        # Partial squares of the norm, which `adam_step` adds up.
        tl.store(squares + program, tl.sum(total * total))
    elif program == 2 * PROGRAMS:
        output = tl.arange(0, OUT)
        column = tl.arange(0, NUM_STATISTICS)
        sums = _block_sums(
            block_partials, OUT + column, column < 6, WIDTH, BLOCKS, ROWS, NUM_STATISTICS
        )
        if not STATE_STD:
            # The std is shared by all rows: its gradient is a sum over all blocks.
            d_std = (
                _block_sums(block_partials, output, output >= 0, WIDTH, BLOCKS, ROWS, OUT) / divisor
            )
            tl.store(gradients + STD_AT + output, d_std)
            tl.store(squares + program, tl.sum(d_std * d_std))
        # How many env states take part. It may be none.
        counted = _column(sums, 0, NUM_STATISTICS)
        number = tl.maximum(counted, 1.0) if RANKS == 1 else divisor
        policy = sums / number
        kl = _column(policy, 2, NUM_STATISTICS)
        if STATE_STD or NODES:
            entropy = _column(policy, 4, NUM_STATISTICS)
        else:
            acts = output < ACTIONS
            # The entropy of a shared std is the same in each row, and computed once from the parameter.
            raw = tl.load(
                biases + (NUM_BIASES - OUT + output), mask=acts, other=0.0 if LOG_STD else 1.0
            )
            std = tl.maximum(tl.exp(raw) if LOG_STD else raw, MIN_STD)
            entropy = tl.sum(tl.where(acts, tl.log(std) + (0.5 + HALF_LOG_2_PI), 0.0)) * (
                counted / number
            )
        tl.store(summary + SHARE, counted / divisor)
        tl.store(summary, _column(policy, 1, NUM_STATISTICS))
        tl.store(summary + 2, entropy)
        tl.store(summary + 3, kl)
        tl.store(summary + 4, _column(policy, 3, NUM_STATISTICS))
        if MIRROR:
            tl.store(summary + LOSS_MIRROR, _column(policy, 5, NUM_STATISTICS))
        # Several ranks adapt the rate in `take_means`, from the divergence of all of them.
        alone: tl.constexpr = ADAPTIVE and RANKS == 1
        tl.store(summary + LEARNING_RATE, _adapt(learning_rate, kl, desired_kl, rate_bounds, alone))
    else:
        # The last program has the value's statistics: loss, and the moments of targets and errors.
        count = tl.zeros((ROWS,), dtype=tl.float32)
        loss = count
        target = count
        error = count
        target_squares = count
        error_squares = count
        for first in range(0, BLOCKS, ROWS):
            block = first + tl.arange(0, ROWS)
            keep = block < BLOCKS
            # Past the row of the actor and the critic's unused columns of the std.
            row = block_partials + (block * 2 * WIDTH + WIDTH + OUT)
            size = tl.load(row, mask=keep, other=0.0)
            loss += tl.load(row + 1, mask=keep, other=0.0)
            total = tl.load(row + 2, mask=keep, other=0.0)
            own = tl.load(row + 3, mask=keep, other=0.0)
            target, target_squares = _merged(count, target, target_squares, size, total, own)
            total = tl.load(row + 4, mask=keep, other=0.0)
            own = tl.load(row + 5, mask=keep, other=0.0)
            error, error_squares = _merged(count, error, error_squares, size, total, own)
            count += size
        counted = tl.sum(count)
        # With more ranks the division by the rows that took part waits until sums of all ranks are there.
        number = tl.maximum(counted, 1.0) if RANKS == 1 else divisor
        # The share of the targets' variance that the critic leaves unexplained.
        left = _variance(count, error, error_squares) / (
            _variance(count, target, target_squares) + EPS
        )
        tl.store(summary + 1, critic_coeff * tl.sum(loss) / number)
        tl.store(summary + 5, (1.0 - left) * (counted / number))


@triton.jit
def take_means(
    gradients, squares, learning_rate, summary, desired_kl, rate_bounds,
    NUM_GRADIENTS: tl.constexpr, ADAPTIVE: tl.constexpr, SIZE: tl.constexpr,
):  # fmt: skip
    """Take squares and means of the sums of `sum_gradients`, added up over ranks, and adapt the learning rate."""
    # Gradients and statistics lie end to end, so that one collective adds up both over the ranks.
    sums = gradients + NUM_GRADIENTS
    at = tl.program_id(0) * SIZE + tl.arange(0, SIZE)
    gradient = tl.load(gradients + at, mask=at < NUM_GRADIENTS, other=0.0)
    tl.store(squares + tl.program_id(0), tl.sum(gradient * gradient))
    if tl.program_id(0) == 0:
        share = tl.load(sums + SHARE)
        scale = 1.0 / tl.maximum(share, 1e-30)  # all sums are zero where no env state takes part
        rate = _adapt(learning_rate, tl.load(sums + 3) * scale, desired_kl, rate_bounds, ADAPTIVE)
        column = tl.arange(0, SIZE)
        means = tl.load(sums + column, mask=column < SHARE) * scale
        tl.store(
            summary + column, tl.where(column == LEARNING_RATE, rate, means), mask=column < SHARE
        )
        tl.store(summary + SHARE, share)


# One kernel for all steps, whose places are not all whole numbers of 16 bytes.
@triton.jit(do_not_specialize_on_alignment=["steps"])
def adam_step(
    parameters, means, variances, places, gradients, weights, exact_weights, squares, summary,
    steps, skipped, skipped_in_a_row,
    beta1, beta2, log_beta1, log_beta2, adam_eps, weight_decay, max_grad_norm, entropy_coeff,
    SIZE: tl.constexpr, NUM_SQUARES: tl.constexpr, SQUARES: tl.constexpr, CLIP: tl.constexpr,
    TF32: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Make one step of Adam (Kingma and Ba, arXiv 1412.6980), as torch's, on the clipped gradient.

    Gradients and NUM_SQUARES partial `squares`, divided by the SHARE of the rows, are means. If the norm or the loss is
    not finite, nothing changes but the counters of skipped steps. Parameters, means and variances are in flat form,
    [SIZE] and zeros that fill the last program; `places` leads from it to the padded form of gradients and of the
    weights, in the dtype of the products and exact, which follow the parameters. Loss, norm and whether the step was
    skipped go to the `summary` of this step, and the number of steps made after it behind that before it.
    """
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = at < SIZE
    # Distant memory is asked for before threads wait for each other.
    place = tl.load(places + at)
    parameter = tl.load(parameters + at)
    mean = tl.load(means + at)
    variance = tl.load(variances + at)
    gradient = tl.load(gradients + place, mask=inside, other=0.0)
    square_at = tl.arange(0, SQUARES)
    share = tl.maximum(tl.load(summary + SHARE), 1e-30)  # all is zero where no env state takes part
    norm = (
        tl.sqrt(tl.sum(tl.load(squares + square_at, mask=square_at < NUM_SQUARES, other=0.0)))
        / share
    )
    loss = tl.load(summary) + tl.load(summary + 1) + tl.load(summary + LOSS_MIRROR)
    loss -= entropy_coeff * tl.load(summary + 2)
    rate = tl.load(summary + LEARNING_RATE)
    step = tl.load(steps)
    made = (norm < float("inf")) & (tl.abs(loss) < float("inf"))
    # In float64: 1 - beta^steps_made loses most digits of float32 in the first steps.
    steps_made = step.to(tl.float64) + 1.0
    correction1 = (1.0 - tl.exp(steps_made * log_beta1)).to(tl.float32)
    correction2 = (1.0 - tl.exp(steps_made * log_beta2)).to(tl.float32)

    # Means of the rows that took part, clipped by the norm of all gradients.
    gradient = gradient / share * (tl.minimum(max_grad_norm / (norm + 1e-6), 1.0) if CLIP else 1.0)
    # As torch's Adam: the decay is a part of the gradient, not decoupled as in AdamW.
    gradient += weight_decay * parameter
    new_mean = mean + (gradient - mean) * (1.0 - beta1)
    new_variance = beta2 * variance + (1.0 - beta2) * gradient * gradient
    change = (
        (rate / correction1) * new_mean / (tl.sqrt(new_variance) / tl.sqrt(correction2) + adam_eps)
    )
    # A step that is not finite writes back the old values.
    parameter = tl.where(made, parameter - change, parameter)
    tl.store(parameters + at, parameter)
    tl.store(means + at, tl.where(made, new_mean, mean))
    tl.store(variances + at, tl.where(made, new_variance, variance))
    tl.store(weights + place, operand(parameter, weights.dtype.element_ty, TF32), mask=inside)
    tl.store(exact_weights + place, parameter, mask=inside)
    if tl.program_id(0) == 0:
        # One program keeps the counters and the summary of this step.
        miss = tl.where(made, 0, 1).to(tl.int64)
        in_a_row = (tl.load(skipped_in_a_row) + miss) * miss
        tl.store(skipped, tl.load(skipped) + miss)
        tl.store(skipped_in_a_row, in_a_row)
        # The next step reads its number here: the kernel is launched with the place one further on.
        tl.store(steps + 1, tl.where(made, step + 1.0, step))
        tl.store(summary + LOSS, loss)
        tl.store(summary + GRAD_NORM, norm)
        tl.store(summary + SKIPPED, miss.to(tl.float32))
        tl.store(summary + SKIPPED_IN_A_ROW, in_a_row.to(tl.float32))


@triton.jit
def mean_steps(
    summary, step_means, longest_skip, STEPS: tl.constexpr, POWER_OF_STEPS: tl.constexpr, COLUMNS: tl.constexpr
):  # fmt: skip
    """Write the means of all columns over the steps that were made, and how many in a row were skipped at most."""
    row = tl.arange(0, POWER_OF_STEPS)[:, None]
    at = summary + row * COLUMNS
    inside = row < STEPS
    # Rows beyond the steps count as skipped.
    made = tl.load(at + SKIPPED, mask=inside, other=1.0) == 0.0
    # The measurements of a skipped step would spoil the means.
    column = tl.arange(0, COLUMNS)
    total = tl.sum(tl.load(at + column[None, :], mask=made, other=0.0), 0)
    tl.store(step_means + column, total / tl.maximum(tl.sum(made.to(tl.float32)), 1.0))
    in_a_row = tl.load(at + SKIPPED_IN_A_ROW, mask=inside, other=0.0)
    tl.store(longest_skip, tl.max(in_a_row).to(tl.int64))
