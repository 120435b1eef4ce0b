"""This module projects distributions of returns on their atoms by one Triton kernel."""

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

ROWS = 4  # of a program, each by a warp


def project_by_kernel(
    probs: Float[Tensor, "*batch A"],
    reward: Float[Tensor, "#*batch 1"],
    discount: Float[Tensor, "#*batch 1"],
    support_A: Float[Tensor, " A"],
) -> Float[Tensor, "*batch A"]:
    """Do what `project_distribution` says in one kernel, which gathers instead of scattering."""
    batch, count = probs.shape[:-1], probs.shape[-1]
    moves = [move.expand(*batch, 1).reshape(-1).contiguous() for move in (reward, discount)]
    projected = torch.empty(probs.shape, dtype=probs.dtype, device=probs.device)
    launch: Any = _project_rows[(triton.cdiv(batch.numel(), ROWS),)]
    launch(
        probs.contiguous(),
        *moves,
        support_A,
        projected,
        batch.numel(),
        count,
        ROWS=ROWS,
        LANES=triton.next_power_of_2(count),
        num_warps=ROWS,
    )
    return projected


@triton.jit
def _project_rows(
    probs, reward, discount, support, projected, num_rows, count, ROWS: tl.constexpr, LANES: tl.constexpr
):
    row = (tl.program_id(0) * ROWS + tl.arange(0, ROWS))[:, None]
    atom = tl.arange(0, LANES)[None, :]
    valid = row < num_rows
    low, high = tl.load(support), tl.load(support + count - 1)
    scale = tl.load(discount + row, mask=valid, other=0.0)
    # Atom i moves to `start + scale * i`, in units of the spacing.
    start = (tl.load(reward + row, mask=valid, other=0.0) + scale * low - low) * (count - 1) / (high - low)
    own = row.to(tl.int64) * count
    mass = tl.load(probs + own + atom, mask=valid & (atom < count), other=0.0)
    moved = start + scale * atom
    below = tl.sum(tl.where(moved < 0.0, mass, 0.0), 1)[:, None]
    above = tl.sum(tl.where(moved > count - 1, mass, 0.0), 1)[:, None]
    total = tl.where(atom == 0, below, 0.0) + tl.where(atom == count - 1, above, 0.0)
    # Where the episode has ended, all atoms move to one place.
    ended = (scale == 0.0) & (start >= 0.0) & (start <= count - 1)
    total += tl.where(ended, tl.sum(mass, 1)[:, None] * tl.maximum(1.0 - tl.abs(start - atom), 0.0), 0.0)
    # Elsewhere those that come to lie within one spacing of an atom are neighbours, and few.
    apart = tl.maximum(scale, 1e-6)
    tries = tl.where(scale == 0.0, 0.0, tl.minimum(2.0 / apart + 3.0, count * 1.0)).to(tl.int32)
    first = tl.ceil((atom - 1.0 - start) / apart) - 1.0
    first = tl.where(tries == count, 0.0, tl.minimum(tl.maximum(first, -1.0 * count), count * 1.0)).to(
        tl.int32
    )
    step = 0
    most = tl.max(tries)
    while step < most:
        source = first + step
        there = (step < tries) & (source >= 0) & (source < count)
        mass = tl.load(probs + own + source, mask=there, other=0.0)
        moved = start + scale * source
        share = tl.maximum(1.0 - tl.abs(moved - atom), 0.0)
        total += tl.where((moved >= 0.0) & (moved <= count - 1), mass * share, 0.0)
        step += 1
    tl.store(projected + own + atom, total, mask=valid & (atom < count))
