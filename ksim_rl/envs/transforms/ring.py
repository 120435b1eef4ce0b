"""The last values of a signal, in a ring of slots per env, as one kernel that is also a torch operator.

A step writes one value per env and reads the values of some steps ago; a reset writes the value that the masked rows
begin with, and no lag reaches back beyond it. Where the ring stands is a counter on the device, so that a captured step
goes on correctly.
"""

import torch
import warp as wp
from torch import Tensor

from ksim_rl.physics.quick_launch import QuickLaunch, address


@wp.struct
class _Ring:
    width: int
    num_bytes: int
    value_stride: int
    num_slots: int
    num_frames: int
    lag_row_stride: int
    lag_frame_stride: int
    clock: wp.uint64
    start: wp.uint64
    lag: wp.uint64
    mask: wp.uint64
    value: wp.uint64
    ring: wp.uint64
    out: wp.uint64


# Rows of the ring are bytes, so that one kernel serves every dtype. A thread copies one word, of 16, 4 or 1, of all
# frames: the GPU waits for many of them at once.
@wp.func_native(r"""
    struct alignas(16) Wide { unsigned word[4]; };
    const int width = a.width, num_bytes = a.num_bytes, num_slots = a.num_slots;
    const unsigned long long now = *(const unsigned long long*)a.clock;
    // Whole numbers of 32 bits divide much faster.
    const int slot = now >> 32 ? (int)(now % (unsigned)num_slots) : (int)((unsigned)now % (unsigned)num_slots);
    const bool resets = a.mask != 0;
    const bool begins = resets && ((const unsigned char*)a.mask)[row];
    unsigned char* ring = (unsigned char*)a.ring + (long long)row * num_slots * num_bytes + part * width;
    const unsigned char* value = (const unsigned char*)a.value + (long long)row * a.value_stride + part * width;
    unsigned char* out = (unsigned char*)a.out + (long long)row * a.num_frames * num_bytes + part * width;
    long long* start = (long long*)a.start + row;

    auto copy = [=](unsigned char* to, const unsigned char* from) {
        if (width == 16) *(Wide*)to = *(const Wide*)from;
        else if (width == 4) *(unsigned*)to = *(const unsigned*)from;
        else memcpy(to, from, width);
    };
    if (begins || !resets) copy(ring + slot * num_bytes, value);
    if (begins && part == 0) *start = (long long)now;
    const long long age = resets ? 0 : (long long)now - *start;
    for (int frame = 0; frame < a.num_frames; ++frame) {
        long long lag = 0;
        if (!resets) {
            lag = ((const long long*)a.lag)[row * a.lag_row_stride + frame * a.lag_frame_stride];
            lag = lag < age ? lag : age;
        }
        const int from = slot - (int)lag;
        copy(out + frame * num_bytes, lag == 0 ? value : ring + (from < 0 ? from + num_slots : from) * num_bytes);
    }
""")
def _copy(row: int, part: int, a: _Ring): ...


@wp.kernel(enable_backward=False, grid_stride=False)
def _push_and_read(a: _Ring):
    row, part = wp.tid()
    _copy(row, part, a)


_quick = QuickLaunch(_push_and_read, _Ring)


def push_and_read(ring_EM: Tensor, start_E: Tensor, clock: Tensor, value_E: Tensor, lag_EN: Tensor) -> Tensor:
    """Write the values of this step and return those of some steps ago.

    Args:
        ring_EM: M slots per env, [E, M, ...].
        start_E: what the clock showed when each env last reset, int64.
        clock: env steps so far, int64 [].
        value_E: [E, ...], in the dtype of the ring.
        lag_EN: env steps, int64, each below M; the tensor may be an expanded one.

    Returns:
        [E, N, ...]. A lag that reaches back beyond the last reset gives the value of that.
    """
    return _run(ring_EM, start_E, clock, value_E, lag_EN, None, lag_EN.shape[1])


def begin(
    ring_EM: Tensor, start_E: Tensor, clock: Tensor, value_E: Tensor, mask_E: Tensor, num_frames: int = 1
) -> Tensor:
    """Let the masked rows begin with these values, and return each row's value `num_frames` times, [E, N, ...]."""
    return _run(ring_EM, start_E, clock, value_E, None, mask_E, num_frames)


def _run(*arguments: object) -> Tensor:
    # Eager code goes past torch's dispatcher, which takes longer than the launch.
    if torch.compiler.is_compiling():
        return _ring(*arguments)  # pyright: ignore[reportArgumentType]
    return _launch(*arguments)  # pyright: ignore[reportArgumentType]


def _launch(
    ring_EM: Tensor,
    start_E: Tensor,
    clock: Tensor,
    value_E: Tensor,
    lag_EN: Tensor | None,
    mask_E: Tensor | None,
    num_frames: int,
) -> Tensor:
    if not _has_whole_rows(value_E):
        value_E = value_E.contiguous()
    device = value_E.device
    out_EN = value_E.new_empty((value_E.shape[0], num_frames, *value_E.shape[1:]))
    num_bytes = value_E.shape[1:].numel() * value_E.element_size()
    value_stride = value_E.stride(0) * value_E.element_size()
    # A thread copies a word of each frame on the GPU, and all of an env on the CPU.
    addresses = [address(t) for t in (clock, start_E, lag_EN, mask_E, value_E, ring_EM, out_EN)]
    if device.type == "cpu":
        width = num_bytes
    else:
        bits = num_bytes | value_stride | value_E.data_ptr()
        width = 16 if bits % 16 == 0 else 4 if bits % 4 == 0 else 1
    row_stride, frame_stride = (0, 0) if lag_EN is None else lag_EN.stride()
    layout = width, num_bytes, value_stride, ring_EM.shape[1], num_frames
    dim = (value_E.shape[0], num_bytes // max(width, 1))
    _quick(device, dim, *layout, row_stride, frame_stride, *addresses)
    return out_EN


def _has_whole_rows(value_E: Tensor) -> bool:
    """Whether each env's value is contiguous, as in columns of a wider tensor."""
    return value_E.ndim == 1 or value_E.ndim == 2 and value_E.stride(1) == 1 or value_E.is_contiguous()


_ring = torch.library.custom_op("ksim_rl::ring", _launch, mutates_args=("ring_EM", "start_E"))


@_ring.register_fake
def _(
    ring_EM: Tensor,
    start_E: Tensor,
    clock: Tensor,
    value_E: Tensor,
    lag_EN: Tensor | None,
    mask_E: Tensor | None,
    num_frames: int,
) -> Tensor:
    return value_E.new_empty((value_E.shape[0], num_frames, *value_E.shape[1:]))
