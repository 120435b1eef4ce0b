"""This module projects distributions of returns on their atoms by one Triton kernel."""

from typing import Any

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor


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
    launch: Any = _project_row[(batch.numel(),)]
    given = probs.contiguous(), *moves, support_A, projected, count
    launch(*given, LANES=triton.next_power_of_2(count), num_warps=1)
    return projected


@triton.jit
def _project_row(probs, reward, discount, support, projected, count, LANES: tl.constexpr):
    row = tl.program_id(0)
    atom = tl.arange(0, LANES)
    low, high = tl.load(support), tl.load(support + count - 1)
    scale = tl.load(discount + row)
    # Atom i moves to `start + scale * i`, in units of the spacing.
    start = (tl.load(reward + row) + scale * low - low) * (count - 1) / (high - low)
    mass = tl.load(probs + row * count + atom, mask=atom < count, other=0.0)
    moved = start + scale * atom
    total = tl.where(atom == 0, tl.sum(tl.where(moved < 0.0, mass, 0.0)), 0.0)
    total += tl.where(atom == count - 1, tl.sum(tl.where(moved > count - 1, mass, 0.0)), 0.0)
    # Those that come to lie within one spacing of an atom are neighbours: few, unless the episode has ended.
    apart = tl.maximum(scale, 1e-6)
    tries = tl.minimum(2.0 / apart + 3.0, count * 1.0).to(tl.int32)
    first = tl.ceil((atom - 1.0 - start) / apart) - 1.0
    first = tl.where(tries == count, 0.0, tl.minimum(tl.maximum(first, -1.0 * count), count * 1.0)).to(
        tl.int32
    )
    step = 0
    while step < tries:
        source = first + step
        there = (source >= 0) & (source < count)
        mass = tl.load(probs + row * count + source, mask=there, other=0.0)
        moved = start + scale * source
        share = tl.maximum(1.0 - tl.abs(moved - atom), 0.0)
        total += tl.where((moved >= 0.0) & (moved <= count - 1), mass * share, 0.0)
        step += 1
    tl.store(projected + row * count + atom, total, mask=atom < count)
