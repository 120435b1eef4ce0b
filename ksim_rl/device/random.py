"""Random numbers are drawn here as a pure function of (seed, stream, env row, counter).

A generator with hidden state gives other numbers as soon as one more reset happens somewhere. Here each draw is a
hash of its coordinates, as in Salmon et al., "Parallel random numbers: as easy as 1, 2, 3" (SC 2011): one row's reset
never changes another row's numbers, a masked reset at every step and TorchRL's reset-when-any-done agree exactly, and
a resumed run needs only the integers. The mixing function is Wellons' two-round 32-bit hash (constants from his
"hash-prospector" search), in wrapping 32-bit arithmetic, so that each device gives the same bits.

Draws made at every step are keyed by a step counter; draws made at a reset by a per-env counter of resets. A draw is
one Warp kernel, which is also a torch operator: it can be captured and compiled. A normal is the inverse of the normal
distribution's cumulative function at a uniform (Giles, "Approximating the erfinv function", 2010): one hash per number
and no branch, so that the CPU's compiler turns loops into vector instructions. A permutation takes no sort, but a
Feistel network of places (Luby and Rackoff, "How to construct pseudorandom permutations", 1988).
"""

import zlib
from typing import NamedTuple

import torch
from jaxtyping import Float32, Int, Int64
from torch import Tensor

from ksim_rl.device import draws_in_torch as in_torch
from ksim_rl.device import group
from ksim_rl.device.quick_launch import as_operator, launch_of

_UNIFORM, _NORMAL, _INTEGER, _ORDER = range(4)


class RowKeys(NamedTuple):
    """The coordinates of one draw, up to the number within the row."""

    seed: Tensor
    stream: int
    counter: Tensor
    num_rows: int
    first_row: int


def stream_id(name: str) -> int:
    """Return a stable 31-bit id for a named stream of draws (the same in every process)."""
    # Python's own hash of a string differs from process to process.
    return zlib.crc32(name.encode()) & 0x7FFFFFFF


def row_keys(
    seed: Int64[Tensor, ""],
    stream: int,
    counter: Int[Tensor, "*rows"],
    num_rows: int,
    *,
    shared: bool = False,
) -> RowKeys:
    """Name the coordinates of one draw for each env row; with several ranks, rows are counted over all of them.

    Two streams (see `stream_id`) never share numbers. The counter has shape [] (all rows at the same count) or [E].
    With `shared`, all ranks draw the same numbers.
    """
    return RowKeys(seed, stream, counter, num_rows, 0 if shared else group.first_row(num_rows))


def uniform(
    keys: RowKeys,
    n: int,
    low: float | Float32[Tensor, "*low"] = 0.0,
    high: float | Float32[Tensor, "*high"] = 1.0,
) -> Float32[Tensor, "E L"]:
    """Draw `n` numbers per env row from the uniform distribution on [low, high); tensors broadcast to [E, L]."""
    if isinstance(low, Tensor) and isinstance(high, Tensor):
        return torch.lerp(low, high, uniform(keys, n))
    if isinstance(low, Tensor) or isinstance(high, Tensor):
        return low + uniform(keys, n) * (high - low)
    # Numbers of the kernel itself are scaled there, in the same launch.
    return _drawn(*keys, n, _UNIFORM, float(low), float(high), 0, 1)


def normal(keys: RowKeys, n: int) -> Float32[Tensor, "E L"]:
    """Draw `n` numbers per env row from the standard normal distribution."""
    return _drawn(*keys, n, _NORMAL, 0.0, 1.0, 0, 1)


def integers(
    keys: RowKeys, n: int, low: int | Int64[Tensor, "*low"], high: int | Int64[Tensor, "*high"]
) -> Int64[Tensor, "E L"]:
    """Draw `n` integers per env row from {low, ..., high}; `high - low`, of [E, L], must be below 2^31."""
    # Scaling keeps the bias below span / 2^32, without the rejection loop that would need a host sync.
    if isinstance(low, int) and isinstance(high, int):
        if not 0 <= high - low < 1 << 31:
            raise ValueError(f"low={low}, high={high}: expected low <= high < low + 2^31")
        return _drawn(*keys, n, _INTEGER, 0.0, 1.0, low, high - low + 1)
    bits_EL = _drawn(*keys, n, _INTEGER, 0.0, 1.0, 0, 1 << 32)
    # 32 random bits times the span, whose upper half is the number.
    return low + ((bits_EL * (high - low + 1)) >> 32)


def permutations(keys: RowKeys, n: int) -> Int64[Tensor, "E L"]:
    """Draw for each count an order of `n` numbers per row: row 0 has 0 to n - 1, row 1 the next n, and so on."""
    # Short halves need more rounds until all orders of few numbers are about equally likely.
    bits = max((n - 1).bit_length(), 2)
    # A permutation of its own for each count, and for each row within it.
    keys = keys._replace(num_rows=keys.counter.numel() * keys.num_rows)
    return _drawn(*keys, n, _ORDER, 0.0, 1.0, bits, 8 if bits > 6 else 24)


# On the CPU one thread fills all rows, in loops of vector instructions.
_launch = launch_of("ksim_rl/device/draw.cuh")


def _draw_now(
    seed: Tensor,
    stream: int,
    counter: Tensor,
    num_rows: int,
    first_row: int,
    n: int,
    kind: int,
    low: float,
    high: float,
    start: int,
    span: int,
) -> Tensor:
    # Checked before, since the kernel trusts the sizes.
    counts = _number_of_counts(seed, counter, num_rows, kind)
    if kind == _ORDER:
        stride = num_rows // counts
    else:
        stride = counter.ndim
    out_EL = _empty(seed, num_rows, n, kind)
    counter = counter.contiguous()
    # A GPU has a thread for each number.
    if seed.device.type == "cpu":
        rows = num_rows
        columns = n
    else:
        rows = 1
        columns = 1
    dim = (num_rows // max(rows, 1), n // max(columns, 1))
    layout = rows, columns, n, kind, low, high, start, span, stream, stride, first_row
    _launch(seed.device, dim, *layout, seed.data_ptr(), counter.data_ptr(), out_EL.data_ptr())
    return out_EL


def _number_of_counts(seed: Tensor, counter: Tensor, num_rows: int, kind: int) -> int:
    """Return how many counts a draw needs, where it has more than one; a ValueError where it has others."""
    if kind == _ORDER:
        counts = counter.numel()
    else:
        counts = num_rows
    if (
        seed.dtype != torch.int64
        or counter.dtype != torch.int64
        or counter.shape not in ((), (counts,))
    ):
        raise ValueError(
            f"seed is {seed.dtype}, counter is {counter.dtype} of shape {tuple(counter.shape)}: expected torch.int64, "
            f"and a counter of shape () or ({counts},)"
        )
    return counts


def _draw_in_torch(
    seed: Tensor,
    stream: int,
    counter: Tensor,
    num_rows: int,
    first_row: int,
    n: int,
    kind: int,
    low: float,
    high: float,
    start: int,
    span: int,
) -> Tensor:
    """Draw the kernel's numbers by torch; for orders, `start` is a number of bits and `span` one of rounds."""
    counts = _number_of_counts(seed, counter, num_rows, kind)
    if kind == _ORDER:
        rows = num_rows // counts
        orders = []
        for count in counter.reshape(-1):
            keys = in_torch.keys_of(seed, stream, count, num_rows=rows, first_row=first_row)
            # Row r has the numbers from r n on.
            first_number_E = torch.arange(rows, device=seed.device)[:, None] * n
            orders.append(first_number_E + in_torch.permuted(keys, n, start, span))
        return torch.cat(orders)
    keys = in_torch.keys_of(seed, stream, counter, num_rows=num_rows, first_row=first_row)
    # Each column is hashed on its own, as in the kernel.
    bits_EL = in_torch.bits_of(keys, torch.arange(n, device=seed.device))
    if kind == _UNIFORM:
        return low + in_torch.unit(bits_EL) * (high - low)
    if kind == _NORMAL:
        return in_torch.normal(bits_EL)
    return in_torch.whole(bits_EL, start, span)


def _empty(seed: Tensor, num_rows: int, n: int, kind: int) -> Tensor:
    # Kinds from integers on are whole numbers.
    return seed.new_empty((num_rows, n), dtype=torch.int64 if kind >= _INTEGER else torch.float32)


_drawn = as_operator(
    "draw",
    _draw_now,
    lambda *given: _empty(given[0], given[3], *given[5:7]),
    in_torch=_draw_in_torch,
)
