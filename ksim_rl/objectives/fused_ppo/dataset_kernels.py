"""The Triton kernels that read a rollout into observations, records and advantages."""

import triton
import triton.language as tl

from ksim_rl.objectives.fused_ppo.loss_kernels import ADVANTAGE, LOG_PROB, MASK, TARGET, VALUE
from ksim_rl.objectives.fused_ppo.mlp_kernels import read_rows


@triton.jit
def _counted_odd(value):
    # How many elements of each row are not finite.
    return tl.sum(tl.where(tl.abs(value.to(tl.float32)) < float("inf"), 0, 1), 1)


@triton.jit
def read_observations(
    source, mean, var, obs, faults, known, values, next_values, places, count, num_rows, num_envs, eps,
    WIDTH: tl.constexpr, STORED: tl.constexpr, LANES: tl.constexpr, NORMALIZED: tl.constexpr, TF32: tl.constexpr,
    LISTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write `source` [D, WIDTH], normalized or not, to `obs` [D, STORED], as products take it; padding is zero.

    Whether an element of a row is not finite is written to `faults` [D], where given. LISTED, of what follows env
    states only what the next step does not begin with is written, in any order, the rows to `places`, their number to
    `count`. Other rows take the value of `known` a step later.
    """
    row = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, LANES)[None, :]
    keep = row < num_rows
    at = row
    value = read_rows(
        source, row[:, None], column, keep[:, None], mean, var, eps, obs, WIDTH, NORMALIZED, TF32
    )
    if LISTED:
        # The memory is time-major: one step later is `num_envs` rows further on.
        later = row + num_envs
        follows = (later < num_rows)[:, None] & (column < STORED)
        begun = tl.load(known + later[:, None] * STORED + column, mask=follows, other=0.0)
        # Where no reset lies between, the next observation is the same as the next step's first.
        same = (later < num_rows) & (tl.sum(tl.where(value == begun, 0, 1), 1) == 0)
        tl.store(next_values + row, tl.load(values + later, mask=same, other=0.0), mask=same)
        keep = keep & (same == 0)
        # The others are packed: each program reserves its places by one atomic addition.
        ones = tl.where(keep, 1, 0)
        at = (tl.atomic_add(count, tl.sum(ones)) + tl.cumsum(ones, 0) - 1).to(tl.int64)
        tl.store(places + at, row.to(tl.int32), mask=keep)
    elif faults is not None:
        tl.store(faults + row, (_counted_odd(value) > 0).to(tl.int8), mask=keep)
    tl.store(obs + at[:, None] * STORED + column, value, mask=keep[:, None] & (column < STORED))


@triton.jit
def write_records(
    action, loc, scale, action_log_prob, advantages, values, targets, moments, obs, faults, records, left_out,
    num_rows, num_obs, first, size, num_moments, min_advantage_std,
    RECORD: tl.constexpr, RECORD_LANES: tl.constexpr, ACTIONS: tl.constexpr, OUT: tl.constexpr, STORED: tl.constexpr,
    LANES: tl.constexpr, MOMENTS: tl.constexpr, STANDARDIZED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the records of some steps, or of their images, which begin at row `first`; padding has a std of 1.

    A row that is not finite takes no part: its record is neutral, its mask 0, its observations are zeros, as a zero
    times NaN is NaN. `left_out` [programs] counts it, without images. STANDARDIZED advantages have a mean of 0 and a
    standard deviation of 1, by the `moments` [num_moments, 3] that `estimate_advantages` left.
    """
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = rows < num_rows
    # Images have the advantages of the env states that they mirror.
    estimated = (first + rows) % size
    advantage = tl.load(advantages + estimated, mask=valid, other=0.0)
    if STANDARDIZED:
        part = tl.arange(0, MOMENTS)
        # Moments of the parts, of all ranks, are merged into one mean and one std.
        known = part < num_moments
        counts = tl.load(moments + 3 * part, mask=known, other=0.0)
        means = tl.load(moments + 3 * part + 1, mask=known, other=0.0)
        count = tl.sum(counts)
        mean = tl.sum(counts * means) / tl.maximum(count, 1.0)
        gap = means - mean
        squares = tl.sum(
            tl.load(moments + 3 * part + 2, mask=known, other=0.0) + counts * gap * gap
        )
        std = tl.sqrt(squares / tl.maximum(count - 1.0, 1.0))
        advantage = (advantage - mean) / tl.maximum(std, min_advantage_std)
    row = rows[:, None]
    column = tl.arange(0, RECORD_LANES)[None, :]
    # Which of action, mean and std a column belongs to, and of which action it is.
    kind = column // OUT
    output = column % OUT
    own = row * ACTIONS + output
    used = valid[:, None] & (output < ACTIONS)
    # A std of 1 has a logarithm and an inverse; all else is neutral as zero.
    neutral = tl.where(kind == 2, 1.0, 0.0)
    record = tl.where(used, 0.0, neutral)
    record += tl.load(action + own, mask=used & (kind == 0), other=0.0)
    record += tl.load(loc + own, mask=used & (kind == 1), other=0.0)
    record += tl.load(scale + own, mask=used & (kind == 2), other=0.0)
    # The columns behind the three blocks are single numbers.
    signal = column - 3 * OUT
    log_prob = tl.load(action_log_prob + rows, mask=valid, other=0.0)
    value = tl.load(values + estimated, mask=valid, other=0.0)
    target = tl.load(targets + estimated, mask=valid, other=0.0)
    record = tl.where(signal == LOG_PROB, log_prob[:, None], record)
    record = tl.where(signal == ADVANTAGE, advantage[:, None], record)
    record = tl.where(signal == VALUE, value[:, None], record)
    record = tl.where(signal == TARGET, target[:, None], record)
    record = tl.where(signal == MASK, 1.0, record)
    lane = tl.arange(0, LANES)[None, :]
    inside = valid[:, None] & (lane < STORED)
    of_actor = obs + row * STORED + lane
    of_critic = of_actor + num_obs.to(tl.int64) * STORED
    # The record and both networks' observations have to be finite.
    odd = _counted_odd(record)
    odd += tl.load(faults + first + rows, mask=valid, other=0)
    odd += tl.load(faults + num_obs + first + rows, mask=valid, other=0)
    is_odd = (odd > 0)[:, None]
    record = tl.where(is_odd, neutral, record)
    tl.store(records + row * RECORD + column, record, mask=valid[:, None] & (column < RECORD))
    # Rare, so that most programs skip these stores.
    if tl.sum(odd) > 0:
        tl.store(of_actor, 0.0, mask=inside & is_odd)
        tl.store(of_critic, 0.0, mask=inside & is_odd)
    tl.store(
        left_out + tl.program_id(0),
        tl.sum(tl.where(valid & (odd > 0) & (first + rows < size), 1, 0)),
    )
