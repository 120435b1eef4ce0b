"""Counter-based random numbers: a pure function of (seed, stream, env row, counter).

A generator with hidden state gives other numbers as soon as one more reset happens somewhere. Here each draw is a
hash of its coordinates, as in Salmon et al., "Parallel random numbers: as easy as 1, 2, 3" (SC 2011): one row's reset
never changes another row's numbers, a masked reset at every step and TorchRL's reset-when-any-done agree exactly, and
a resumed run needs only the integers. The mixing function is Wellons' two-round 32-bit hash (constants from his
"hash-prospector" search), in wrapping 32-bit arithmetic, so that each device gives the same bits.

Draws made at every step are keyed by a step counter; draws made at a reset by a per-env counter of resets. A draw is
one Warp kernel, wrapped as a torch operator: it can be captured and compiled.
"""

import zlib
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from ksim_rl.physics.streams import warp_scope

_UNIFORM, _NORMAL = range(2)
_GOLDEN = wp.constant(wp.uint32(0x9E3779B9))
_MUL_1, _MUL_2 = wp.constant(wp.uint32(0x21F0AAAD)), wp.constant(wp.uint32(0xD35A2D97))


class RowKeys(NamedTuple):
    """The coordinates of one draw, up to the number within the row."""

    seed: Tensor
    stream: int
    counter: Tensor
    num_rows: int


def stream_id(name: str) -> int:
    """Return a stable 31-bit id for a named stream of draws (the same in every process)."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


def row_keys(seed: Tensor, stream: int, counter: Tensor, num_rows: int) -> RowKeys:
    """Name the coordinates of one draw for each env row.

    Args:
        seed: int64, shape [].
        stream: the id of what is drawn (see `stream_id`); two streams never share numbers.
        counter: int64, shape [] (all rows at the same count) or [E].
        num_rows: E.
    """
    return RowKeys(seed, stream, counter, num_rows)


def uniform(keys: RowKeys, n: int, low: float | Tensor = 0.0, high: float | Tensor = 1.0) -> Tensor:
    """Draw from the uniform distribution on [low, high).

    Args:
        n: numbers per env row.
        low, high: floats, or float32 tensors that broadcast to [E, n].

    Returns:
        float32 [E, n].
    """
    if isinstance(low, Tensor) and isinstance(high, Tensor):
        return torch.lerp(low, high, _draw(*keys, n, _UNIFORM, 0.0, 1.0))
    if isinstance(low, Tensor) or isinstance(high, Tensor):
        return low + _draw(*keys, n, _UNIFORM, 0.0, 1.0) * (high - low)
    return _draw(*keys, n, _UNIFORM, float(low), float(high))


def normal(keys: RowKeys, n: int) -> Tensor:
    """Draw from the standard normal distribution (Box and Muller, 1958), float32 [E, n]."""
    return _draw(*keys, n, _NORMAL, 0.0, 1.0)


def integers(keys: RowKeys, n: int, low: int | Tensor, high: int | Tensor) -> Tensor:
    """Draw integers from {low, ..., high}, both included.

    Args:
        n: numbers per env row.
        low, high: ints, or int64 tensors that broadcast to [E, n]. `high - low` must be below 2^31.

    Returns:
        int64 [E, n].
    """
    bits_EL = _draw_bits(*keys, n)
    # Scaling keeps the bias below span / 2^32, without the rejection loop that would need a host sync.
    return low + ((bits_EL * (high - low + 1)) >> 32)


@wp.func
def _mix(word: wp.uint32) -> wp.uint32:
    x = word
    x = (x ^ (x >> wp.uint32(16))) * _MUL_1
    x = (x ^ (x >> wp.uint32(15))) * _MUL_2
    return x ^ (x >> wp.uint32(15))


@wp.func
def _bits(
    seed: wp.int64, stream: wp.uint32, counter: wp.int64, row: wp.uint32, index: wp.uint32
) -> wp.uint32:
    low = wp.uint32(counter & wp.int64(0xFFFFFFFF))
    high = wp.uint32((counter >> wp.int64(32)) & wp.int64(0xFFFFFFFF))
    base = _mix(wp.uint32((seed ^ (seed >> wp.int64(32))) & wp.int64(0xFFFFFFFF)) ^ stream)
    first = _mix(base + low * _GOLDEN) ^ _mix(row + high + wp.uint32(1))
    second = _mix(first + row * _GOLDEN + _GOLDEN) ^ _mix(low + stream)
    return _mix(_mix(_mix(first) ^ ((index + wp.uint32(1)) * _GOLDEN)) ^ _mix(second))


@wp.func
def _unit(bits: wp.uint32) -> float:
    return float(bits >> wp.uint32(8)) * 5.9604644775390625e-08  # 2^-24


@wp.kernel(enable_backward=False)
def _fill(
    seed: wp.array[wp.int64],
    stream: wp.uint32,
    counter: wp.array[wp.int64],
    counter_stride: int,
    kind: int,
    low: float,
    high: float,
    out: wp.array2d[float],
):
    row, i = wp.tid()
    count = counter[row * counter_stride]
    if kind == 0:
        out[row, i] = low + _unit(_bits(seed[0], stream, count, wp.uint32(row), wp.uint32(i))) * (high - low)
    else:
        u = _unit(_bits(seed[0], stream, count, wp.uint32(row), wp.uint32(2 * i)))
        v = _unit(_bits(seed[0], stream, count, wp.uint32(row), wp.uint32(2 * i + 1)))
        # 1 - u lies in (0, 1], so that the logarithm is finite.
        out[row, i] = wp.sqrt(-2.0 * wp.log(1.0 - u)) * wp.cos(6.283185307179586 * v)


@wp.kernel(enable_backward=False)
def _fill_bits(
    seed: wp.array[wp.int64],
    stream: wp.uint32,
    counter: wp.array[wp.int64],
    counter_stride: int,
    out: wp.array2d[wp.int64],
):
    row, i = wp.tid()
    count = counter[row * counter_stride]
    out[row, i] = wp.int64(_bits(seed[0], stream, count, wp.uint32(row), wp.uint32(i)))


@torch.library.custom_op("ksim_rl::draw", mutates_args=())
def _draw(
    seed: Tensor, stream: int, counter: Tensor, num_rows: int, n: int, kind: int, low: float, high: float
) -> Tensor:
    out_EL = torch.empty(num_rows, n, dtype=torch.float32, device=seed.device)
    _launch(_fill, seed, stream, counter, [kind, low, high], out_EL)
    return out_EL


@torch.library.custom_op("ksim_rl::draw_bits", mutates_args=())
def _draw_bits(seed: Tensor, stream: int, counter: Tensor, num_rows: int, n: int) -> Tensor:
    out_EL = torch.empty(num_rows, n, dtype=torch.int64, device=seed.device)
    _launch(_fill_bits, seed, stream, counter, [], out_EL)
    return out_EL


@_draw.register_fake
def _(
    seed: Tensor, stream: int, counter: Tensor, num_rows: int, n: int, kind: int, low: float, high: float
) -> Tensor:
    return seed.new_empty((num_rows, n), dtype=torch.float32)


@_draw_bits.register_fake
def _(seed: Tensor, stream: int, counter: Tensor, num_rows: int, n: int) -> Tensor:
    return seed.new_empty((num_rows, n), dtype=torch.int64)


def _launch(
    kernel: wp.Kernel, seed: Tensor, stream: int, counter: Tensor, options: list[int | float], out_EL: Tensor
) -> None:
    with warp_scope(out_EL.device):
        stride = int(counter.ndim > 0)
        seeds = wp.from_torch(seed.reshape(1), dtype=wp.int64, return_ctype=True)
        counts = wp.from_torch(counter.reshape(-1), dtype=wp.int64, return_ctype=True)
        out = wp.from_torch(out_EL, return_ctype=True)
        inputs = [seeds, stream, counts, stride, *options]
        wp.launch(kernel, dim=tuple(out_EL.shape), inputs=inputs, outputs=[out], device=str(out_EL.device))
