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
import warp as wp
from jaxtyping import Float32, Int, Int64
from torch import Tensor

from ksim_rl import ranks
from ksim_rl.device.quick_launch import QuickLaunch, arguments_of, as_operator

DRAWS = r"""
    const unsigned golden = 0x9E3779B9u;
    auto mix = [](unsigned x) {
        x = (x ^ (x >> 16)) * 0x21F0AAADu;
        x = (x ^ (x >> 15)) * 0xD35A2D97u;
        return x ^ (x >> 15);
    };
    struct RowKey { unsigned first, second; };
    auto key_of = [=](long long seed, unsigned stream, long long count, int row) {
        const unsigned low = (unsigned)count, high = (unsigned)((unsigned long long)count >> 32);
        const unsigned base = mix((unsigned)(seed ^ (seed >> 32)) ^ stream);
        const unsigned first = mix(base + low * golden) ^ mix((unsigned)row + high + 1u);
        const unsigned second = mix(first + (unsigned)row * golden + golden) ^ mix(low + stream);
        return RowKey{mix(first), mix(second)};
    };
    auto bits_of = [=](RowKey key, unsigned index) {
        return mix(mix(key.first ^ ((index + 1u) * golden)) ^ key.second);
    };
    auto unit = [](unsigned b) { return (float)(b >> 8) * 5.9604644775390625e-08f; };
    auto horner = [](float x, float sum, auto... coefficients) {
        ((sum = sum * x + coefficients), ...);
        return sum;
    };
    auto normal = [=](unsigned b) {
        const float x = ((float)((int)(b >> 8) - 8388608) + 0.5f) * 1.1920928955078125e-07f;
        const float t = (1.0f - x) * (1.0f + x);
        unsigned word;
        memcpy(&word, &t, 4);
        int exponent = (int)(word >> 23) - 127;
        word = (word & 0x7FFFFFu) | 0x3F800000u;
        float mantissa;
        memcpy(&mantissa, &word, 4);
        const bool is_large = mantissa > 1.41421356f;
        exponent += is_large;
        const float f = (is_large ? 0.5f * mantissa : mantissa) - 1.0f;
        const float s = horner(f, 7.0376836292e-2f, -1.1514610310e-1f, 1.1676998740e-1f, -1.2420140846e-1f,
            1.4249322787e-1f, -1.6668057665e-1f, 2.0000714765e-1f, -2.4999993993e-1f, 3.3333331174e-1f);
        const float w = -(f + f * f * (s * f - 0.5f) + (float)exponent * 0.693147180559945f);
        const float p = horner(w - 2.5f, 2.81022636e-08f, 3.43273939e-07f, -3.5233877e-06f, -4.39150654e-06f,
            2.1858087e-04f, -1.25372503e-03f, -4.17768164e-03f, 2.46640727e-01f, 1.50140941f);
        const float d = sqrtf(w < 5.0f ? 5.0f : w) - 3.0f;
        const float q = horner(d, -2.00214257e-04f, 1.00950558e-04f, 1.34934322e-03f, -3.67342844e-03f,
            5.73950773e-03f, -7.6224613e-03f, 9.43887047e-03f, 1.00167406f, 2.83297682f);
        return 1.41421356237f * x * (w < 5.0f ? p : q);
    };
"""
"""C++ of all kernels that draw: `key_of` once per row, `bits_of` per number, `unit` or `normal` of these bits."""

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
    What is `shared` is drawn alike by all ranks.
    """
    return RowKeys(seed, stream, counter, num_rows, 0 if shared else ranks.first_row(num_rows))


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
    return low + ((_drawn(*keys, n, _INTEGER, 0.0, 1.0, 0, 1 << 32) * (high - low + 1)) >> 32)


def permutations(keys: RowKeys, n: int) -> Int64[Tensor, "E L"]:
    """Draw for each count an order of `n` numbers per row: row 0 has 0 to n - 1, row 1 the next n, and so on."""
    # Short halves need more rounds until all orders of few numbers are about equally likely.
    bits = max((n - 1).bit_length(), 2)
    keys = keys._replace(num_rows=keys.counter.numel() * keys.num_rows)
    return _drawn(*keys, n, _ORDER, 0.0, 1.0, bits, 8 if bits > 6 else 24)


# On the CPU one thread fills all rows, in loops of vector instructions.
_launch = QuickLaunch(
    arguments_of(
        (int, "rows columns n kind"),
        (float, "low high"),
        (wp.int64, "start span"),
        (wp.uint32, "stream"),
        (int, "counter_stride first_row"),
        (wp.uint64, "seed counter out"),
    ),
    DRAWS
    + r"""
    const long long seed = *(const long long*)a.seed;
    const long long* __restrict__ counter = (const long long*)a.counter;
    const int begin_row = part * a.rows, begin = chunk * a.columns, n = a.n, stride = a.counter_stride;
    const int first = a.first_row, end_row = begin_row + a.rows, end = begin + a.columns;
    const unsigned stream = a.stream;
    auto fill = [&](auto write) {
        for (int row = begin_row; row < end_row; ++row) {
            const RowKey key = key_of(seed, stream, counter[row * stride], first + row);
            for (int i = begin; i < end; ++i) write((long long)row * n + i, bits_of(key, (unsigned)i));
        }
    };
    auto fill_one_each = [&](auto write) {
        for (int row = begin_row; row < end_row; ++row)
            write(row, bits_of(key_of(seed, stream, counter[row * stride], first + row), 0u));
    };
    auto run = [&](auto write) { n == 1 ? fill_one_each(write) : fill(write); };
    float* __restrict__ reals = (float*)a.out;
    long long* __restrict__ integers = (long long*)a.out;
    const float low = a.low, high = a.high;
    const long long start = a.start;
    const unsigned long long span = (unsigned long long)a.span;
    if (a.kind == 0) run([=](long long at, unsigned b) { reals[at] = low + unit(b) * (high - low); });
    else if (a.kind == 1) run([=](long long at, unsigned b) { reals[at] = normal(b); });
    else if (a.kind == 2) run([=](long long at, unsigned b) { integers[at] = start + (long long)((b * span) >> 32); });
    else for (int row = begin_row; row < end_row; ++row) {
        // A bijection of the next power of two; what it takes past the last number goes through it again (Black and
        // Rogaway, "Ciphers with arbitrary finite domains", 2002).
        const RowKey key = key_of(seed, stream, counter[row / stride], first + row % stride);
        unsigned low_bits = start / 2, low_mask = (1u << low_bits) - 1u, high_mask = (1u << (start - low_bits)) - 1u;
        unsigned round_keys[24];
        for (int round = 0; round < (int)span; ++round) round_keys[round] = bits_of(key, (unsigned)round);
        for (int i = begin; i < end; ++i) {
            unsigned number = i;
            do {
                unsigned low = number & low_mask, high = number >> low_bits;
                for (int round = 0; round < (int)span; round += 2) {
                    low ^= mix(high ^ round_keys[round]) & low_mask;
                    high ^= mix(low ^ round_keys[round + 1]) & high_mask;
                }
                number = (high << low_bits) | low;
            } while (number >= (unsigned)n);
            integers[(long long)row * n + i] = (long long)(row % stride) * n + number;
        }
    }
""",
    indices=("part", "chunk"),
)


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
    counts = counter.numel() if kind == _ORDER else num_rows
    stride = num_rows // counts if kind == _ORDER else counter.ndim
    if seed.dtype != torch.int64 or counter.dtype != torch.int64 or counter.shape not in ((), (counts,)):
        raise ValueError(
            f"seed is {seed.dtype}, counter is {counter.dtype} of shape {tuple(counter.shape)}: expected torch.int64, "
            f"and a counter of shape () or ({counts},)"
        )
    out_EL, counter = _empty(seed, num_rows, n, kind), counter.contiguous()
    rows, columns = (num_rows, n) if seed.device.type == "cpu" else (1, 1)
    dim = (num_rows // max(rows, 1), n // max(columns, 1))
    layout = rows, columns, n, kind, low, high, start, span, stream, stride, first_row
    _launch(seed.device, dim, *layout, seed.data_ptr(), counter.data_ptr(), out_EL.data_ptr())
    return out_EL


def _empty(seed: Tensor, num_rows: int, n: int, kind: int) -> Tensor:
    return seed.new_empty((num_rows, n), dtype=torch.int64 if kind >= _INTEGER else torch.float32)


_drawn = as_operator("draw", _draw_now, lambda *given: _empty(given[0], given[3], *given[5:7]))
