"""What trackers count per env, as kernels that are also torch operators: each one counts and copies in a single launch."""

import torch
import warp as wp
from torch import Tensor

from ksim_rl.physics.quick_launch import QuickLaunch, address

_COUNT_DOWN = r"""
    const unsigned char* mask = (const unsigned char*)mask_;
    float* __restrict__ left = (float*)left_;
    float* __restrict__ out = (float*)out_;
    for (int row = begin; row < end; ++row) {
        const float less = left[row] - 1.0f;
        const float next = mask ? (mask[row] ? horizon : left[row]) : (less > 0.0f ? less : 0.0f);
        left[row] = next;
        out[row] = next / divisor;
    }
"""

_TALLY = r"""
    const unsigned char* mask = (const unsigned char*)mask_;
    const float* __restrict__ reward = (const float*)reward_;
    float* __restrict__ total = (float*)total_;
    float* __restrict__ total_out = (float*)total_out_;
    long long* __restrict__ step = (long long*)step_;
    long long* __restrict__ step_out = (long long*)step_out_;
    for (int row = begin; row < end; ++row) {
        const long long next = mask ? (mask[row] ? 0 : step[row]) : step[row] + 1;
        step[row] = next;
        step_out[row] = next;
    }
    for (int row = begin; row < end; ++row) {
        const float next = mask ? (mask[row] ? 0.0f : total[row]) : total[row] + reward[row];
        total[row] = next;
        total_out[row] = next;
    }
"""


@wp.func_native(_COUNT_DOWN)
def _count_down_rows(
    begin: int,
    end: int,
    horizon: float,
    divisor: float,
    mask_: wp.uint64,
    left_: wp.uint64,
    out_: wp.uint64,
): ...


@wp.func_native(_TALLY)
def _tally_rows(
    begin: int,
    end: int,
    mask_: wp.uint64,
    reward_: wp.uint64,
    total_: wp.uint64,
    step_: wp.uint64,
    total_out_: wp.uint64,
    step_out_: wp.uint64,
): ...


@wp.kernel(enable_backward=False, grid_stride=False)
def _count_down_kernel(
    rows: int, horizon: float, divisor: float, mask: wp.uint64, left: wp.uint64, out: wp.uint64
):
    begin = wp.tid() * rows
    _count_down_rows(begin, begin + rows, horizon, divisor, mask, left, out)


@wp.kernel(enable_backward=False, grid_stride=False)
def _tally_kernel(
    rows: int,
    mask: wp.uint64,
    reward: wp.uint64,
    total: wp.uint64,
    step: wp.uint64,
    total_out: wp.uint64,
    step_out: wp.uint64,
):
    begin = wp.tid() * rows
    _tally_rows(begin, begin + rows, mask, reward, total, step, total_out, step_out)


_quick_count_down, _quick_tally = QuickLaunch(_count_down_kernel), QuickLaunch(_tally_kernel)


def count_down(left_E: Tensor, mask_E: Tensor | None, horizon: float, divisor: float) -> Tensor:
    """Take one env step off what is left, down to 0, or, given the rows that reset, let those begin with the horizon.

    Args:
        left_E: env steps, float32, changed in place.
        mask_E: bool; None for a step.

    Returns:
        What is left over the divisor, float32 [E].
    """
    run = _count_down_operator if torch.compiler.is_compiling() else _count_down_now
    return run(left_E, mask_E, horizon, divisor)


def tally(step_E: Tensor, total_E: Tensor, reward_E: Tensor | None, mask_E: Tensor | None) -> list[Tensor]:
    """Count one env step and add its reward, or, given the rows that reset, let those begin at 0.

    Args:
        step_E: steps since the reset, int64, changed in place.
        total_E: sums of rewards since the reset, float32, one per env, changed in place.
        reward_E: in the shape and dtype of the sums; None for a reset.
        mask_E: bool; None for a step.

    Returns:
        Copies of the new steps and sums, in their shapes.
    """
    run = _tally_operator if torch.compiler.is_compiling() else _tally_now
    return run(step_E, total_E, reward_E, mask_E)


def _count_down_now(left_E: Tensor, mask_E: Tensor | None, horizon: float, divisor: float) -> Tensor:
    out_E = torch.empty_like(left_E)
    dim, rows = _share(left_E)
    addresses = address(mask_E), left_E.data_ptr(), out_E.data_ptr()
    _quick_count_down(left_E.device, dim, (rows, horizon, divisor, *addresses))
    return out_E


def _tally_now(
    step_E: Tensor, total_E: Tensor, reward_E: Tensor | None, mask_E: Tensor | None
) -> list[Tensor]:
    if reward_E is not None:
        reward_E = reward_E.contiguous()
    outs = [torch.empty_like(step_E), torch.empty_like(total_E)]
    dim, rows = _share(step_E)
    tensors = mask_E, reward_E, total_E, step_E, outs[1], outs[0]
    _quick_tally(step_E.device, dim, (rows, *map(address, tensors)))
    return outs


def _share(rows_E: Tensor) -> tuple[tuple[int], int]:
    """Return the number of threads and of rows for each: one thread does all on the CPU, in vector instructions."""
    num_rows = rows_E.numel()
    return ((1,), num_rows) if rows_E.device.type == "cpu" else ((num_rows,), 1)


_count_down_operator = torch.library.custom_op(
    "ksim_rl::count_down", _count_down_now, mutates_args=("left_E",)
)
_tally_operator = torch.library.custom_op("ksim_rl::tally", _tally_now, mutates_args=("step_E", "total_E"))


@_count_down_operator.register_fake
def _(left_E: Tensor, mask_E: Tensor | None, horizon: float, divisor: float) -> Tensor:
    return torch.empty_like(left_E)


@_tally_operator.register_fake
def _(step_E: Tensor, total_E: Tensor, reward_E: Tensor | None, mask_E: Tensor | None) -> list[Tensor]:
    return [torch.empty_like(step_E), torch.empty_like(total_E)]
