"""Generalized advantages, and the clipped losses of PPO with their gradients, as Triton functions.

The losses are `ClipPPOLoss`'s, for a diagonal gaussian, or for one that a tanh squashes: actions are then taken
before the tanh. The gradients are of the sum over the env states, not of the mean. `docs/fused_ppo.md` derives them.

The data of an env state are one record: `OUT` columns each of the action, of the old mean and of the old standard
deviation, then `LOG_PROB`, `ADVANTAGE`, `VALUE`, `TARGET` and `MASK`, counted from column 3 OUT.
"""

import triton
import triton.language as tl

LOG_PROB = tl.constexpr(0)
ADVANTAGE = tl.constexpr(1)
VALUE = tl.constexpr(2)
TARGET = tl.constexpr(3)
MASK = tl.constexpr(4)
HALF_LOG_2_PI = tl.constexpr(0.9189385332046727)
LOG_2 = tl.constexpr(0.6931471805599453)


@triton.jit
def policy_gradient(
    loc, raw_std, record, valid, d_std_at, statistics, log_ratio_low, log_ratio_high, entropy_coeff, nodes, log_range,
    ACTIONS: tl.constexpr, OUT: tl.constexpr,
    LOG_STD: tl.constexpr, MIN_STD: tl.constexpr, STATE_STD: tl.constexpr, NODES: tl.constexpr,
):  # fmt: skip
    """Return the gradient of the policy loss and the entropy loss at `loc` and at `raw_std`, both [rows, OUT].

    Writes the sum of the latter to `d_std_at` [OUT], and to `statistics` the sums of mask, policy loss, divergence and
    clipped ratios. With STATE_STD `raw_std` has a row for each of `loc`, and the sum of entropies is written, too; else
    it is [1, OUT]. With NODES, points [NODES, 2] of a quadrature and their weights, actions are squashed to a box with
    a volume of exp(`log_range`) times the volume of [-1, 1], and the entropy is the bounded action's.
    """
    output = tl.arange(0, OUT)[None, :]
    action_dims = output < ACTIONS
    keep = valid[:, None]
    # The columns of the record, in its order; rows beyond the minibatch read harmless values.
    action = tl.load(record[:, None] + output, mask=keep, other=0.0)
    loc_old = tl.load(record[:, None] + (OUT + output), mask=keep, other=0.0)
    scale_old = tl.load(record[:, None] + (2 * OUT + output), mask=keep, other=1.0)
    log_prob_old = tl.load(record + (3 * OUT + LOG_PROB), mask=valid, other=0.0)
    advantage = tl.load(record + (3 * OUT + ADVANTAGE), mask=valid, other=0.0)
    mask = tl.load(record + (3 * OUT + MASK), mask=valid, other=0.0)

    if LOG_STD:
        std = tl.exp(raw_std)
    elif STATE_STD:
        std = tl.maximum(raw_std, 0.0) + tl.log(1.0 + tl.exp(-tl.abs(raw_std)))
    else:
        std = raw_std
    # The floor holds forward only: the gradient below passes it, so that a std under it can come back.
    bounded = tl.maximum(std, MIN_STD)
    inverse = 1.0 / bounded
    log_scale = tl.log(bounded)
    # The log-probability of the stored action, summed over the dims that exist.
    error = (action - loc) * inverse
    log_prob = tl.sum(
        tl.where(action_dims, -0.5 * error * error - log_scale - HALF_LOG_2_PI, 0.0), 1
    )
    # Padding and rows that take no part may be anything, and zero times infinity is NaN.
    counts = mask > 0.0
    log_ratio = tl.where(counts, log_prob - log_prob_old, 0.0)
    clipped = tl.minimum(tl.maximum(log_ratio, log_ratio_low), log_ratio_high)
    # The clipped objective of PPO is the smaller of these two.
    gain = tl.exp(log_ratio) * advantage
    clipped_gain = tl.exp(clipped) * advantage
    inside = clipped == log_ratio
    # Of the smaller of the two gains; the clipped one is constant where it is another.
    slope = tl.where(inside | (gain < clipped_gain), -gain, 0.0) * mask

    error = tl.where(counts[:, None], error, 0.0)
    # By the chain rule, the slope at the log-probability times its derivatives at mean and std.
    d_loc = slope[:, None] * error * inverse
    d_std = (slope[:, None] * (error * error - 1.0) - entropy_coeff * mask[:, None]) * inverse
    log_slope = tl.zeros_like(loc)
    if NODES:  # the mean of log(1 - tanh(u)^2) over the gaussian
        for node in range(NODES):
            at = tl.load(nodes + 2 * node)
            share = tl.load(nodes + 2 * node + 1)
            # Each node is one value before the tanh, at a fixed number of standard deviations from the mean.
            latent = loc + bounded * at
            # From |u| alone, so that the exponential never overflows: the function is even.
            fold = tl.exp(-2.0 * tl.abs(latent))
            log_slope += share * 2.0 * (LOG_2 - tl.abs(latent) - tl.log(1.0 + fold))
            change = tl.where(latent < 0.0, 2.0, -2.0) * (1.0 - fold) / (1.0 + fold) * share
            d_loc -= entropy_coeff * mask[:, None] * change
            d_std -= entropy_coeff * mask[:, None] * change * at
    if LOG_STD:
        d_std = d_std * std
    elif STATE_STD:
        d_std = d_std * tl.sigmoid(raw_std)
    # Padded actions have no std, whose gradient must not leave rubbish in the padding.
    d_std = tl.where(action_dims, d_std, 0.0)
    tl.store(d_std_at + tl.arange(0, OUT), tl.sum(d_std, 0))

    # The divergence of the new policy from the one that collected, dim by dim, in nats.
    log_std_ratio = tl.where(counts[:, None], tl.log(scale_old) - log_scale, 0.0)
    drift = tl.where(counts[:, None], (loc_old - loc) * inverse, 0.0)
    divergence = 0.5 * (tl.exp(2.0 * log_std_ratio) + drift * drift - 1.0) - log_std_ratio
    # Sums over the block; `sum_gradients` divides them by the number of rows that take part.
    tl.store(statistics, tl.sum(mask))
    tl.store(statistics + 1, -tl.sum(tl.minimum(gain, clipped_gain) * mask))
    tl.store(statistics + 2, tl.sum(tl.sum(tl.where(action_dims, divergence, 0.0), 1) * mask))
    tl.store(statistics + 3, tl.sum(tl.where(inside, 0.0, mask)))
    if STATE_STD or NODES:
        entropy = tl.where(action_dims, log_scale + log_slope + (0.5 + HALF_LOG_2_PI), 0.0)
        entropy = tl.sum(entropy, 1) + log_range
        tl.store(statistics + 4, tl.sum(entropy * mask))
    return tl.where(action_dims, d_loc, 0.0), d_std


@triton.jit
def _store_moments(at, values, mask, count):
    total = tl.sum(values * mask)
    # The mean of this block: blocks are merged later by their sums and squares (Chan et al., 1979).
    gap = (values - total / tl.maximum(count, 1.0)) * mask
    tl.store(at, total)
    tl.store(at + 1, tl.sum(gap * gap))


@triton.jit
def value_gradient(
    out, record, valid, statistics, clip_value, critic_coeff,
    OUT: tl.constexpr, CLIP_VALUE: tl.constexpr,
):  # fmt: skip
    """Return the gradient of the value loss at `out` [rows, OUT], whose first column is the value.

    Writes to `statistics` the sums of mask and value loss (without `critic_coeff`), and of targets and errors their sum
    and the sum of squares about their mean, which does not cancel as a sum about zero does.
    """
    output = tl.arange(0, OUT)[None, :]
    # A tile has no indexing: the first column is picked by a masked sum.
    value = tl.sum(tl.where(output == 0, out, 0.0), 1)
    target = tl.load(record + (3 * OUT + TARGET), mask=valid, other=0.0)
    mask = tl.load(record + (3 * OUT + MASK), mask=valid, other=0.0)
    error = tl.where(mask > 0.0, value - target, 0.0)
    loss = error * error
    slope = 2.0 * error
    if CLIP_VALUE:
        value_old = tl.load(record + (3 * OUT + VALUE), mask=valid, other=0.0)
        # The clipped loss of rsl_rl: the larger of the errors of the free and of the held value.
        change = tl.where(mask > 0.0, value - value_old, 0.0)
        held = tl.minimum(tl.maximum(change, -clip_value), clip_value)
        held_error = value_old + held - target
        held_loss = held_error * held_error
        # Where the held loss is larger and the value is held, nothing moves it.
        slope = tl.where((held == change) | (loss > held_loss), slope, 0.0)
        loss = tl.maximum(loss, held_loss)
    slope = slope * mask * critic_coeff
    count = tl.sum(mask)
    tl.store(statistics, count)
    tl.store(statistics + 1, tl.sum(loss * mask))
    _store_moments(statistics + 2, target, mask, count)
    _store_moments(statistics + 4, error, mask, count)
    return tl.where(output == 0, slope[:, None], 0.0)


@triton.jit
def estimate_advantages(
    values, next_values, reward, done, terminated, advantages, targets, moments, num_envs, gamma, decay,
    STEPS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write advantages and value targets of BLOCK envs; all signals are time-major, [STEPS, num_envs].

    As `GAE`: a step whose delta is not finite gets a NaN advantage, and the recursion starts again before it; `decay`
    is gamma * lambda. `moments` [programs, 3] get the finite advantages' number, mean, and sum of squares about it.
    """
    env = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = env < num_envs
    advantage = tl.zeros((BLOCK,), dtype=tl.float32)
    counts = tl.zeros((BLOCK,), dtype=tl.float32)
    means = tl.zeros((BLOCK,), dtype=tl.float32)
    squares = tl.zeros((BLOCK,), dtype=tl.float32)
    # From the last step to the first: each advantage contains the one after it.
    for back in range(1, STEPS + 1):
        at = (STEPS - back) * num_envs + env
        value = tl.load(values + at, mask=inside, other=0.0)
        following = gamma * tl.load(next_values + at, mask=inside, other=0.0)
        ended = tl.load(done + at, mask=inside, other=1) != 0
        # A where instead of a product: after a termination the next value may be NaN.
        bootstrap = tl.where(tl.load(terminated + at, mask=inside, other=1) != 0, 0.0, following)
        delta = tl.load(reward + at, mask=inside, other=0.0) + bootstrap - value
        finite = tl.abs(delta) < float("inf")
        # Nothing is carried over the end of an episode, or over a step that is not finite.
        carried = tl.where(finite & (ended == 0), decay, 0.0) * advantage
        advantage = tl.where(finite, delta, 0.0) + carried
        tl.store(targets + at, advantage + value, mask=inside)
        tl.store(advantages + at, tl.where(finite, advantage, float("nan")), mask=inside)
        # Welford, "Note on a method for calculating corrected sums of squares and products" (1962).
        counted = inside & finite
        counts += tl.where(counted, 1.0, 0.0)
        gap = tl.where(counted, advantage - means, 0.0)
        means += gap / tl.maximum(counts, 1.0)
        squares += gap * tl.where(counted, advantage - means, 0.0)
    # The envs' own moments are merged into the moments of the program.
    count = tl.sum(counts)
    mean = tl.sum(counts * means) / tl.maximum(count, 1.0)
    moments += tl.program_id(0) * 3
    tl.store(moments, count)
    tl.store(moments + 1, mean)
    tl.store(moments + 2, tl.sum(squares + counts * (means - mean) * (means - mean)))
