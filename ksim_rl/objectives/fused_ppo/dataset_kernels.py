"""This module has the Triton kernels that read a rollout into observations, records and advantages."""

import triton
import triton.language as tl

from ksim_rl.objectives.fused_ppo.loss_kernels import ADVANTAGE, LOG_PROB, MASK, TARGET, VALUE
from ksim_rl.objectives.fused_ppo.mlp_kernels import operand


@triton.jit
def read_observations(
    source, mean, var, obs, num_rows, eps,
    DIM: tl.constexpr, STORED: tl.constexpr, LANES: tl.constexpr, NORMALIZED: tl.constexpr, TF32: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Write `source` [D, DIM], normalized or not, to `obs` [D, STORED], as products take it; padding is zero."""
    row = (tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK))[:, None]
    column = tl.arange(0, LANES)[None, :]
    used = column < DIM
    value = tl.load(source + row * DIM + column, mask=(row < num_rows) & used, other=0.0).to(tl.float32)
    if NORMALIZED:
        shift = tl.load(mean + column, mask=used, other=0.0)
        value = (value - shift) / tl.sqrt(tl.load(var + column, mask=used, other=1.0) + eps)
    value = operand(value, obs.dtype.element_ty, TF32)
    tl.store(obs + row * STORED + column, value, mask=(row < num_rows) & (column < STORED))


@triton.jit
def read_actions(
    action, loc, scale, action_log_prob, records, num_rows,
    RECORD: tl.constexpr, ACTIONS: tl.constexpr, OUT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write what the rollout holds of actions [D, ACTIONS] to their records; padding has a standard deviation of 1."""
    row = (tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK))[:, None]
    output = tl.arange(0, OUT)[None, :]
    keep = row < num_rows
    at, used = row * ACTIONS + output, keep & (output < ACTIONS)
    record = records + row * RECORD
    tl.store(record + output, tl.load(action + at, mask=used, other=0.0), mask=keep)
    tl.store(record + OUT + output, tl.load(loc + at, mask=used, other=0.0), mask=keep)
    tl.store(record + 2 * OUT + output, tl.load(scale + at, mask=used, other=1.0), mask=keep)
    tl.store(record + (3 * OUT + LOG_PROB), tl.load(action_log_prob + row, mask=keep, other=0.0), mask=keep)


@triton.jit
def write_estimates(
    obs, records, advantages, values, targets, moments, left_out, num_obs, size, num_moments,
    RECORD: tl.constexpr, RECORD_LANES: tl.constexpr, OUT: tl.constexpr, STORED: tl.constexpr,
    LANES: tl.constexpr, MOMENTS: tl.constexpr, STANDARDIZED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write advantages, values and targets [D], as many as `size`, to the records, the same to those of images.

    What is not finite takes no part: its record is neutral, its mask 0, its observations are zeros, as a zero times NaN
    is NaN. `left_out` [programs] counts it, without images. STANDARDIZED advantages have a mean of 0 and a standard
    deviation of 1, by the `moments` [num_moments, 3] that `estimate_advantages` left.
    """
    rows = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = rows < num_obs
    advantage = tl.load(advantages + rows % size, mask=valid, other=0.0)
    value = tl.load(values + rows % size, mask=valid, other=0.0)
    target = tl.load(targets + rows % size, mask=valid, other=0.0)
    if STANDARDIZED:
        part = tl.arange(0, MOMENTS)
        counts = tl.load(moments + 3 * part, mask=part < num_moments, other=0.0)
        means = tl.load(moments + 3 * part + 1, mask=part < num_moments, other=0.0)
        count = tl.sum(counts)
        mean = tl.sum(counts * means) / tl.maximum(count, 1.0)
        gap = means - mean
        squares = tl.sum(
            tl.load(moments + 3 * part + 2, mask=part < num_moments, other=0.0) + counts * gap * gap
        )
        std = tl.sqrt(squares / tl.maximum(count - 1.0, 1.0))
        advantage = (advantage - mean) / tl.maximum(std, 1e-4)
    column = tl.arange(0, RECORD_LANES)[None, :]
    places = records + rows[:, None] * RECORD + column
    read = valid[:, None] & (column <= 3 * OUT + LOG_PROB)
    record = tl.load(places, mask=read, other=0.0)
    record = tl.where(column == 3 * OUT + ADVANTAGE, advantage[:, None], record)
    record = tl.where(column == 3 * OUT + VALUE, value[:, None], record)
    record = tl.where(column == 3 * OUT + TARGET, target[:, None], record)
    record = tl.where(column == 3 * OUT + MASK, 1.0, record)
    odd = tl.sum(tl.where(tl.abs(record) < float("inf"), 0, 1), 1)
    lane = tl.arange(0, LANES)[None, :]
    at, inside = obs + rows[:, None] * STORED + lane, valid[:, None] & (lane < STORED)
    next_at = at + num_obs.to(tl.int64) * STORED
    odd += tl.sum(
        tl.where(tl.abs(tl.load(at, mask=inside, other=0.0).to(tl.float32)) < float("inf"), 0, 1), 1
    )
    odd += tl.sum(
        tl.where(tl.abs(tl.load(next_at, mask=inside, other=0.0).to(tl.float32)) < float("inf"), 0, 1), 1
    )
    is_odd = (odd > 0)[:, None]
    neutral = tl.where((column >= 2 * OUT) & (column < 3 * OUT), 1.0, 0.0)
    tl.store(places, tl.where(is_odd, neutral, record), mask=valid[:, None] & (column < RECORD))
    none = tl.zeros((BLOCK, LANES), dtype=obs.dtype.element_ty)
    tl.store(at, none, mask=inside & is_odd)
    tl.store(next_at, none, mask=inside & is_odd)
    tl.store(left_out + tl.program_id(0), tl.sum(tl.where(valid & (odd > 0) & (rows < size), 1, 0)))
