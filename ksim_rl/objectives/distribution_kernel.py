"""Compares distributions of returns with their targets by one Triton kernel, gradients included."""

from typing import Any, Protocol

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor
from torch.autograd import Function

from ksim_rl.device.gradient_context import GradientContext

# Lanes that a warp takes, of two rows or more at a time: one row computes while another waits.
LANES = 256
# A power of 2 is one instruction, a power of e several.
LOG2_E = tl.constexpr(1.4426950408889634)


@triton.jit
def _exponentials(at, keep):
    # Returned are logits shifted so that the largest is 0, their exponentials, the sum of these, and the shift.
    logit = tl.load(at, mask=keep, other=-1e30).to(tl.float32)
    peak = tl.max(logit, 1)[:, None]
    units = tl.exp2((logit - peak) * LOG2_E)
    return logit - peak, units, tl.sum(units, 1)[:, None], peak


@triton.jit
def _within(value, last):
    return tl.clamp(value, 0.0, last, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def compare_rows(
    logits, following, reward, discount, support, loss, mean, slope, num_rows, LEARNS: tl.constexpr,
    LOWEST: tl.constexpr, NETWORKS: tl.constexpr, COUNT: tl.constexpr, ROWS: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the results of `Compared` for `ROWS` rows of a network, and the gradient of the loss at its logits.

    Program (i, n) is of network n. `logits`, `following` and `slope` are [N, num_rows, COUNT].
    """
    # A tile [ROWS, LANES]: one lane per atom, and lanes beyond COUNT without one.
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)[:, None]
    atom = tl.arange(0, LANES)[None, :]
    there = row < num_rows
    last = COUNT - 1.0
    keep = there & (atom < COUNT)
    low = tl.load(support)
    spacing = (tl.load(support + COUNT - 1) - low) / last
    own = tl.program_id(1).to(tl.int64) * num_rows + row
    # The predicted distribution and its mean, in float32 whatever the logits are.
    parts = _exponentials(logits + own * COUNT + atom, keep)
    logit, mass, total, _ = parts  # pyright: ignore[reportGeneralTypeIssues]
    mass *= 1.0 / total
    value = low + spacing * tl.sum(mass * atom, 1)[:, None]
    if LEARNS:
        scale = tl.load(discount + row, mask=there, other=0.0)
        # Atom i moves to `start + scale * i`, in units of the spacing.
        start = (tl.load(reward + row, mask=there, other=0.0) + scale * low - low) / spacing
        moved = start + scale * atom
        source = own
        # All critics share the target of the lowest mean, so each program reads the logits of all of them.
        if LOWEST:
            lowest = tl.full((ROWS, 1), float("inf"), tl.float32)
            for network in range(NETWORKS):
                at = row.to(tl.int64) + network * num_rows
                _, of_next, sum_next, _ = _exponentials(following + at * COUNT + atom, keep)
                found = tl.sum(of_next * _within(moved, last), 1)[:, None] / sum_next
                source = tl.where(found < lowest, at, source)
                lowest = tl.minimum(found, lowest)
        following += source * COUNT
        _, of_next, sum_next, peak = _exponentials(following + atom, keep)
        # Mass that moves beyond the ends goes to the end atoms; the loop below sees neighbours only.
        target = tl.where(atom == 0, tl.sum(of_next * _within(-moved, 1.0), 1)[:, None], 0.0)
        target += tl.where(
            atom == last, tl.sum(of_next * _within(moved - last, 1.0), 1)[:, None], 0.0
        )
        # Atoms that come to lie within one spacing of this one are its neighbours, and are read again.
        apart = tl.where(scale > 0.0, scale, 2.0)
        first = tl.floor((atom - 1.0 - start) * (1.0 / apart)) + 1.0
        near = tl.minimum(tl.maximum(first, 0.0), COUNT).to(tl.uint32)
        distance = start + scale * near - atom
        for _ in range(tl.max(tl.minimum(tl.ceil(2.0 / apart), COUNT).to(tl.int32))):
            near_logit = tl.load(following + near, mask=there & (near < COUNT), other=-1e30).to(
                tl.float32
            )
            target += tl.exp2(near_logit * LOG2_E - peak * LOG2_E) * _within(
                1.0 - tl.abs(distance), 1.0
            )
            near = near + 1
            distance = distance + scale
        # Where nothing of the future counts, all atoms move to one place.
        spike = sum_next * _within(1.0 - tl.abs(_within(start, last) - atom), 1.0)
        target = tl.where(scale > 0.0, target, spike) * (1.0 / sum_next)
        # Lanes without an atom have a logit that no sum should see.
        result = tl.sum(tl.where(keep, target * (tl.log(total) - logit), 0.0), 1)[:, None]
        change = mass - target
    else:
        # Without targets the mean itself is the result, and the slope is its gradient.
        result = value
        change = mass * (low + spacing * atom - value)
    tl.store(loss + own, result, mask=there)
    tl.store(mean + own, value, mask=there)
    tl.store(slope + own * COUNT + atom, change.to(slope.dtype.element_ty), mask=keep)


class _ComparingContext(GradientContext, Protocol):
    others: tuple[None, ...]


class Compared(Function):
    """The cross entropies [B, N] of N distributions to their targets, and their means; means twice without targets.

    Arguments are as in `compare`, with whether the lowest counts at the end. Only the first result has gradients,
    which have the dtype of the logits, and the same bits each time.
    """

    @staticmethod
    def forward(
        ctx: _ComparingContext,
        logits_BNA: Float[Tensor, "B N A"],
        support_A: Float[Tensor, " A"],
        *targets: Any,
    ) -> tuple[Float[Tensor, "B N"], Float[Tensor, "B N"]]:
        """Return both, and keep the gradient."""
        # Network by network: the kernel reads the logits of one network as rows that follow each other.
        logits = logits_BNA.transpose(0, 1).contiguous()
        networks, rows, count = logits.shape
        slope = torch.empty_like(logits)
        given = [logits, logits, logits]
        lowest = False
        loss_NB, mean_NB = (support_A.new_empty(networks, rows) for _ in range(2))
        if targets:
            following_BNA, *moves, lowest = targets
            given = following_BNA.transpose(0, 1), *(move.expand(rows, 1) for move in moves)
        given = logits, *(own.contiguous() for own in given), support_A, loss_NB, mean_NB, slope
        # A power of two of lanes holds all atoms; narrow rows share a warp.
        lanes = triton.next_power_of_2(count)
        tall = max(LANES // lanes, 2)
        warps = max(lanes // LANES, 1)
        launch: Any = compare_rows[-(-rows // tall), networks]
        launch(
            *given, rows, len(targets) > 0, lowest, networks, count, tall, lanes, num_warps=warps
        )
        ctx.save_for_backward(slope)
        ctx.others = (None,) * (1 + len(targets))
        return loss_NB.T, mean_NB.T

    @staticmethod
    def backward(
        ctx: _ComparingContext, d_loss_BN: Float[Tensor, "B N"], d_mean_BN: Float[Tensor, "B N"]
    ) -> tuple[Float[Tensor, "*?logits"] | None, ...]:
        """Return the gradient at the logits."""
        (slope_NBA,) = ctx.saved_tensors
        d_logits_NBA = (slope_NBA * d_loss_BN.T[..., None]).to(slope_NBA.dtype)
        # As the part before, compiled by itself, would copy it to lie.
        return d_logits_NBA.transpose(0, 1).contiguous(), *ctx.others
