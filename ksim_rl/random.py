"""Counter-based random numbers: a pure function of (seed, stream, env row, counter).

A generator with hidden state gives other numbers as soon as one more reset happens somewhere. Here each draw is a
hash of its coordinates, as in Salmon et al., "Parallel random numbers: as easy as 1, 2, 3" (SC 2011): one row's reset
never changes another row's numbers, a masked reset at every step and TorchRL's reset-when-any-done agree exactly, and
a resumed run needs only the integers. The mixing function is Wellons' two-round 32-bit hash (constants from his
"hash-prospector" search); all arithmetic is int64 and never exceeds 2^63, so each device gives the same bits.

Draws made at every step are keyed by a step counter; draws made at a reset by a per-env counter of resets.
"""

import math
import zlib
from typing import NamedTuple

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF
# Constants above 2^31 are written as negative numbers: products stay within int64, their low 32 bits are the same.
_GOLDEN = 0x9E3779B9 - (1 << 32)
_MUL_1, _MUL_2 = 0x21F0AAAD, 0xD35A2D97 - (1 << 32)


class RowKeys(NamedTuple):
    """Two 32-bit words per env row, each an int64 tensor of shape [E]."""

    first_E: Tensor
    second_E: Tensor


def stream_id(name: str) -> int:
    """Return a stable 31-bit id for a named stream of draws (the same in every process)."""
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


def _mix(x: Tensor) -> Tensor:
    """Scramble 32-bit words held in int64."""
    x = ((x ^ (x >> 16)) * _MUL_1) & _MASK
    x = ((x ^ (x >> 15)) * _MUL_2) & _MASK
    return x ^ (x >> 15)


def row_keys(seed: Tensor, stream: int, counter: Tensor, num_rows: int) -> RowKeys:
    """Derive the keys of one draw for each env row.

    Args:
        seed: int64, shape [].
        stream: the id of what is drawn (see `stream_id`); two streams never share numbers.
        counter: int64, shape [] (all rows at the same count) or [E].
        num_rows: E.
    """
    row_E = torch.arange(num_rows, device=seed.device, dtype=torch.int64)
    low, high = counter & _MASK, counter >> 32
    base = _mix((seed ^ (seed >> 32)) & _MASK ^ stream)
    first_E = _mix((base + low * _GOLDEN) & _MASK) ^ _mix(row_E + high + 1)
    second_E = _mix((first_E + row_E * _GOLDEN + _GOLDEN) & _MASK) ^ _mix((low + stream) & _MASK)
    return RowKeys(_mix(first_E), _mix(second_E))


def _bits(keys: RowKeys, n: int) -> Tensor:
    """Return uniform 32-bit words, int64 [E, n]."""
    index_L = (torch.arange(1, n + 1, device=keys.first_E.device, dtype=torch.int64) * _GOLDEN) & _MASK
    return _mix(_mix(keys.first_E[:, None] ^ index_L) ^ keys.second_E[:, None])


def uniform(keys: RowKeys, n: int, low: float | Tensor = 0.0, high: float | Tensor = 1.0) -> Tensor:
    """Draw from the uniform distribution on [low, high).

    Args:
        n: numbers per env row.
        low, high: floats, or float32 tensors that broadcast to [E, n].

    Returns:
        float32 [E, n].
    """
    unit_EL = (_bits(keys, n) >> 8).to(torch.float32) * 2.0**-24
    if isinstance(low, float) and isinstance(high, float) and low == 0.0 and high == 1.0:
        return unit_EL
    return low + unit_EL * (high - low)


def normal(keys: RowKeys, n: int) -> Tensor:
    """Draw from the standard normal distribution (Box and Muller, 1958), float32 [E, n]."""
    half = (n + 1) // 2
    unit_EL = uniform(keys, 2 * half)
    # 1 - u lies in (0, 1], so that the logarithm is finite.
    radius_EL = torch.sqrt(-2.0 * torch.log(1.0 - unit_EL[:, :half]))
    angle_EL = (2.0 * math.pi) * unit_EL[:, half:]
    return torch.cat((radius_EL * torch.cos(angle_EL), radius_EL * torch.sin(angle_EL)), dim=1)[:, :n]


def integers(keys: RowKeys, n: int, low: int | Tensor, high: int | Tensor) -> Tensor:
    """Draw integers from {low, ..., high}, both included.

    Args:
        n: numbers per env row.
        low, high: ints, or int64 tensors that broadcast to [E, n]. `high - low` must be below 2^31.

    Returns:
        int64 [E, n].
    """
    span = high - low + 1
    # Scaling keeps the bias below span / 2^32, without the rejection loop that would need a host sync.
    return low + ((_bits(keys, n) * span) >> 32)
