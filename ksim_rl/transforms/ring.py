"""This module keeps the last values of a signal in a ring of slots per env: one kernel, also a torch operator.

A step writes one value per env and reads the values of some steps ago; a reset writes the value that the masked rows
begin with, and no lag reaches back beyond it. Where the ring of an env stands is its age, the steps since its reset,
which the kernel counts on the device, so that a captured step goes on correctly.
"""

import math

import torch
import warp as wp
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device.quick_launch import QuickLaunch, address, arguments_of, as_operator
from ksim_rl.device.random import DRAWS

_ARGUMENTS = arguments_of(
    (int, "width lanes num_bytes value_stride num_slots num_frames stride num_parts counts first_row"),
    (wp.uint32, "stream"),
    (int, "lowest span"),
    (wp.uint64, "seed draw_count age lag mask parts value ring out"),
)
# Rows of the ring are bytes, so that one kernel serves every dtype. The lanes of a row copy words of 16, 4 or 1 bytes,
# a few at once, as the GPU waits for all of them together; on the CPU one lane copies whole parts.
_quick = QuickLaunch(
    _ARGUMENTS,
    DRAWS
    + r"""
    struct alignas(16) Wide { unsigned word[4]; };
    const int num_bytes = a.num_bytes, num_slots = a.num_slots, num_frames = a.num_frames, lanes = a.lanes;
    long long* age = (long long*)a.age + row;
    const long long before = *age;
    // All lanes of a row have to read the age before one of them counts on.
    #if defined(__CUDA_ARCH__)
        if (lanes == 32) __syncwarp(); else __syncthreads();
    #endif
    const bool resets = a.mask != 0;
    const bool writes = !resets || ((const unsigned char*)a.mask)[row];
    const long long now = resets ? 0 : before + 1;
    if (lane == 0 && writes && a.counts) *age = now;
    if (lane == 0 && resets && writes && a.draw_count) {
        const long long count = ++((long long*)a.draw_count)[row];
        const RowKey key = key_of(*(const long long*)a.seed, a.stream, count, a.first_row + row);
        const unsigned long long bits = bits_of(key, 0u);
        ((long long*)a.lag)[row] = a.lowest + (long long)((bits * (unsigned)a.span) >> 32);
    }
    // Whole numbers of 32 bits divide much faster.
    const int slot = now >> 32 ? (int)(now % (unsigned)num_slots) : (int)((unsigned)now % (unsigned)num_slots);
    const long long newest = a.lag && !resets ? ((const long long*)a.lag)[row] : 0;
    const long long stride = resets ? 0 : a.stride;
    unsigned char* ring = (unsigned char*)a.ring + (long long)row * num_slots * num_bytes;
    const unsigned char* value = (const unsigned char*)a.value + (long long)row * a.value_stride;
    unsigned char* out = (unsigned char*)a.out + (long long)row * num_frames * num_bytes;

    auto frame_of = [=](int frame) {
        const long long wanted = newest + (num_frames - 1 - frame) * stride;
        const int lag = (int)(wanted < now ? wanted : now), from = slot - lag;
        return lag == 0 ? value : ring + (long long)(from < 0 ? from + num_slots : from) * num_bytes;
    };
    auto copy_words = [=](auto zero) {
        using Word = decltype(zero);
        const int AT_ONCE = 4;
        Word* slot_words = (Word*)(ring + (long long)slot * num_bytes);
        const int words_per_row = num_bytes / (int)sizeof(Word);
        if (writes)
            for (int word = lane; word < words_per_row; word += lanes) slot_words[word] = ((const Word*)value)[word];
        Word* to = (Word*)out;
        int offset = 0;
        for (int part = 0; part < a.num_parts; ++part) {
            const unsigned words = (a.parts ? ((const int*)a.parts)[part] : num_bytes) / (unsigned)sizeof(Word);
            const int items = num_frames * (int)words;
            for (int begin = lane; begin < items; begin += AT_ONCE * lanes) {
                Word found[AT_ONCE];
                #pragma unroll
                for (int k = 0; k < AT_ONCE; ++k) {
                    const unsigned item = begin + k * lanes, frame = item / words;
                    if (item < items) found[k] = ((const Word*)frame_of(frame))[offset + item - frame * words];
                }
                #pragma unroll
                for (int k = 0; k < AT_ONCE; ++k)
                    if (begin + k * lanes < items) to[begin + k * lanes] = found[k];
            }
            to += items;
            offset += words;
        }
    };
    if (a.width == 16) copy_words(Wide());
    else if (a.width == 4) copy_words(0u);
    else if (a.width == 1) copy_words((unsigned char)0);
    else {
        if (writes) memcpy(ring + (long long)slot * num_bytes, value, num_bytes);
        for (int frame = 0; frame < num_frames; ++frame) {
            const unsigned char* from = frame_of(frame);
            int offset = 0;
            for (int part = 0; part < a.num_parts; ++part) {
                const int size = a.parts ? ((const int*)a.parts)[part] : num_bytes;
                memcpy(out + offset * num_frames + frame * size, from + offset, size);
                offset += size;
            }
        }
    }
""",
)
_LANES, _MANY_LANES = 32, 256
"""Threads that share a row on the GPU: a warp, or a block for large rows."""


def _launch(
    ring_EM: Tensor,
    age_E: Tensor,
    value_E: Tensor,
    lag_E: Tensor | None,
    mask_E: Tensor | None,
    num_frames: int,
    stride: int,
    parts: Tensor | None,
    counts: bool,
    seed: Tensor | None = None,
    draw_count_E: Tensor | None = None,
    stream: int = 0,
    lowest: int = 0,
    highest: int = 0,
) -> Tensor:
    """Go on by one step: write its values, and return those of some steps ago, N frames of L elements per env.

    The ring has M slots per env. `lag_E` (int64, 0 for None) is that of the newest frame, which is the last, below M;
    one that reaches back beyond the reset gives the value of that. The age, the steps since each env's reset, is
    changed in place; of several rings with one age only the last one `counts` it on. `parts` are sizes in bytes (int32)
    of what a value consists of: all frames of the first part are returned, then all of the second one, and so on.

    With a mask no step is made: its rows begin with these values, and each row's value is returned N times. With a
    `draw_count_E`, the resets of each row, these rows also draw new lags: those of `ksim_rl.device.random.integers` at
    the counts that they reach. Lags and counts are changed in place.
    """
    # Columns of a wider tensor stay there: each env's value is contiguous.
    if value_E.ndim > 2 or value_E.ndim == 2 and value_E.stride(1) != 1:
        value_E = value_E.contiguous()
    num_rows, num_slots, *leaf = ring_EM.shape
    device, item_size = value_E.device, value_E.element_size()
    size = leaf[0] if len(leaf) == 1 else math.prod(leaf)
    out_EL = torch.empty((num_rows, num_frames * size), dtype=value_E.dtype, device=device)
    num_bytes, value_stride, value = size * item_size, value_E.stride(0) * item_size, value_E.data_ptr()
    num_parts = 1 if parts is None else parts.shape[0]
    if device.type == "cpu":
        width, lanes = 0, 1
    else:
        bits = num_bytes | value_stride | value if parts is None else item_size
        width = 16 if bits % 16 == 0 else 4 if bits % 4 == 0 else 1
        lanes = _LANES if num_frames * num_bytes <= 32 * _LANES * width * num_parts else _MANY_LANES
    layout = width, lanes, num_bytes, value_stride, num_slots, num_frames, stride, num_parts, counts
    first_row = ranks.first_row(num_rows)
    draws = first_row, stream, lowest, highest - lowest + 1, address(seed), address(draw_count_E)
    tensors = age_E.data_ptr(), address(lag_E), address(mask_E), address(parts), value
    _quick(device, (num_rows, lanes), *layout, *draws, *tensors, ring_EM.data_ptr(), out_EL.data_ptr())
    return out_EL


turn = as_operator(
    "ring",
    _launch,
    lambda ring_EM, _age_E, value_E, _lag_E, _mask_E, num_frames, *_: value_E.new_empty(
        (ring_EM.shape[0], num_frames * ring_EM.shape[2:].numel())
    ),
    mutates=("ring_EM", "age_E", "lag_E", "draw_count_E"),
)
