"""The hash of `random` by torch, for machines without Warp: the same bits, and normals that agree up to rounding.

Numbers of 32 bits are held in int64, whose products wrap around, so that the low 32 bits of them are right.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float32, Int64
from torch import Tensor

MASK = 0xFFFFFFFF
GOLDEN = 0x9E3779B9


class Keys(NamedTuple):
    """The keys that are mixed into the bits of each row: two numbers of 32 bits, [E] each."""

    first_E: Tensor
    second_E: Tensor


def mix(x: Int64[Tensor, "*shape"]) -> Int64[Tensor, "*shape"]:
    """Mix 32 bits, as `draws.cuh` does."""
    # Constants of Wellons' hash: the product is cut to 32 bits after each step.
    x = ((x ^ (x >> 16)) * 0x21F0AAAD) & MASK
    x = ((x ^ (x >> 15)) * 0xD35A2D97) & MASK
    return x ^ (x >> 15)


def keys_of(
    seed: Int64[Tensor, ""],
    stream: int,
    count: Int64[Tensor, "*rows"],
    *,
    num_rows: int,
    first_row: int,
) -> Keys:
    """Return the keys of `num_rows` rows at a common count [], or at a count each, [E]."""
    row_E = torch.arange(first_row, first_row + num_rows, device=seed.device)
    # Counts and seeds have 64 bits, which are mixed as two halves.
    low = count & MASK
    high = (count >> 32) & MASK
    base = mix(((seed ^ (seed >> 32)) & MASK) ^ stream)
    first_E = mix((base + low * GOLDEN) & MASK) ^ mix((row_E + high + 1) & MASK)
    second_E = mix((first_E + row_E * GOLDEN + GOLDEN) & MASK) ^ mix((low + stream) & MASK)
    return Keys(mix(first_E), mix(second_E))


def bits_of(keys: Keys, index_L: Int64[Tensor, " L"]) -> Int64[Tensor, "E L"]:
    """Return 32 bits for each row and each index."""
    index_L = ((index_L + 1) * GOLDEN) & MASK
    return mix(mix(keys.first_E[:, None] ^ index_L) ^ keys.second_E[:, None])


def unit(bits: Int64[Tensor, "*shape"]) -> Float32[Tensor, "*shape"]:
    """Return numbers of [0, 1): 24 of the 32 bits."""
    return (bits >> 8).float() * 2.0**-24


def normal(bits: Int64[Tensor, "*shape"]) -> Float32[Tensor, "*shape"]:
    """Return numbers of the standard normal distribution: the inverse of its cumulative function."""
    # In float64, since float32 has few digits left where the argument is close to 1.
    x = ((bits >> 8).double() - 2.0**23 + 0.5) * 2.0**-23
    return (math.sqrt(2.0) * torch.erfinv(x)).float()


def whole(bits: Int64[Tensor, "*shape"], low: int, span: int) -> Int64[Tensor, "*shape"]:
    """Return whole numbers of {low, ..., low + span - 1}, for a span up to 2^32."""
    # The product has 64 bits, whose upper half is meant; the shift would copy the sign into it.
    return low + (((bits * span) >> 32) & MASK)


def permuted(keys: Keys, n: int, bits: int, rounds: int) -> Int64[Tensor, "E n"]:
    """Return an order of 0 to n - 1 for each row, by a Feistel network on numbers of so many bits."""
    device = keys.first_E.device
    low_bits = bits // 2
    # The network works on two halves of the bits, which differ by one bit at most.
    low_mask = (1 << low_bits) - 1
    high_mask = (1 << (bits - low_bits)) - 1
    # One key of 32 bits for each round and row.
    round_keys = bits_of(keys, torch.arange(rounds, device=device)).unsqueeze(1).unbind(-1)

    def through(number: Tensor) -> Tensor:
        low = number & low_mask
        high = number >> low_bits
        for place in range(0, rounds, 2):
            # Each round changes one half by a mix of the other, so that it can be undone: no number comes twice.
            low = low ^ (mix(high ^ round_keys[place]) & low_mask)
            high = high ^ (mix(low ^ round_keys[place + 1]) & high_mask)
        return (high << low_bits) | low

    number = through(torch.arange(n, device=device).expand(len(keys.first_E), n))
    # Numbers past the last one, up to the next power of two, go through the network again.
    while bool((number >= n).any()):
        number = torch.where(number >= n, through(number), number)
    return number
