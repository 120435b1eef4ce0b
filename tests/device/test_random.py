import math

import pytest
import torch

from ksim_rl.device import random

SEED = torch.tensor(5)
MASK = 0xFFFFFFFF


def zero(value: int = 0) -> torch.Tensor:
    return torch.tensor(value)


def keys(stream: int = 1, counter: int = 0, rows: int = 4, seed: int = 5) -> random.RowKeys:
    return random.row_keys(torch.tensor(seed), stream, torch.tensor(counter), rows)


def mix(x: int) -> int:
    """Mix 32 bits in exact arithmetic (Wellons' hash 21f0aaad-d35a2d97)."""
    x = ((x ^ (x >> 16)) * 0x21F0AAAD) & MASK
    x = ((x ^ (x >> 15)) * 0xD35A2D97) & MASK
    return x ^ (x >> 15)


def exact_uniform(seed: int, stream: int, row: int, counter: int, index: int) -> float:
    """Repeat the definition with Python's unbounded integers: int64 must not have overflowed anywhere."""
    golden = 0x9E3779B9
    low, high = counter & MASK, counter >> 32
    base = mix(((seed ^ (seed >> 32)) & MASK) ^ stream)
    first = mix((base + low * golden) & MASK) ^ mix(row + high + 1)
    second = mix((first + row * golden + golden) & MASK) ^ mix((low + stream) & MASK)
    bits = mix(mix(mix(first) ^ ((index + 1) * golden & MASK)) ^ mix(second))
    return (bits >> 8) * 2.0**-24


@pytest.mark.parametrize(
    ("seed", "stream", "counter"),
    [
        (0, 0, 0),
        (5, 1, 3),
        (2**31 - 1, 2**31 - 1, 2**31),
        (2**62 + 12345, 77, 2**40 + 9),
        (1, 2, 2**32 - 1),
    ],
)
def test_it_is_the_hash_that_it_says_it_is(seed, stream, counter):
    drawn = random.uniform(random.row_keys(torch.tensor(seed), stream, torch.tensor(counter), 3), 5)
    expected = [
        [exact_uniform(seed, stream, row, counter, index) for index in range(5)] for row in range(3)
    ]
    assert drawn.tolist() == expected


def test_same_coordinates_same_numbers():
    assert torch.equal(random.uniform(keys(), 7), random.uniform(keys(), 7))
    assert torch.equal(random.normal(keys(), 7), random.normal(keys(), 7))


@pytest.mark.parametrize("other", [{"stream": 2}, {"counter": 1}, {"seed": 6}])
def test_each_coordinate_matters(other):
    assert not (random.uniform(keys(), 64) == random.uniform(keys(**other), 64)).any()


def test_a_row_does_not_depend_on_the_others():
    one_E, other_E = torch.tensor([3, 0, 8, 1]), torch.tensor([3, 5, 8, 2])
    one, other = (
        random.uniform(random.row_keys(SEED, 1, counter_E, 4), 6) for counter_E in (one_E, other_E)
    )
    assert torch.equal(one[[0, 2]], other[[0, 2]])
    assert not (one[[1, 3]] == other[[1, 3]]).any()
    fewer = random.uniform(random.row_keys(SEED, 1, one_E[:2], 2), 6)
    assert torch.equal(fewer, one[:2])


def test_a_count_per_row_equals_a_common_count():
    per_row = random.row_keys(SEED, 1, torch.full((4,), 9), 4)
    assert torch.equal(random.uniform(per_row, 3), random.uniform(keys(counter=9), 3))


def assert_mean(sample: torch.Tensor, mean: float, std: float) -> None:
    assert sample.numel() >= 100_000
    assert abs(sample.double().mean() - mean) < 4 * std / math.sqrt(sample.numel())


def test_uniform_moments_range_and_cells():
    sample = random.uniform(keys(rows=2000), 100)
    assert sample.min() >= 0 and sample.max() < 1
    assert_mean(sample, 0.5, 1 / math.sqrt(12))
    assert_mean(sample**2, 1 / 3, math.sqrt(1 / 5 - 1 / 9))
    cells = torch.histc(sample, bins=64, min=0, max=1)
    expected = sample.numel() / 64
    chi_square = float(((cells - expected) ** 2 / expected).sum())
    assert abs(chi_square - 63) < 4 * math.sqrt(2 * 63)


def test_uniform_limits_may_be_tensors():
    low, high = torch.tensor([0.0, -5.0]), torch.tensor([1.0, -4.0])
    sample = random.uniform(keys(rows=1000), 2, low, high)
    assert bool((sample >= low).all()) and bool((sample < high).all())


def test_normal_moments_and_tails():
    sample = random.normal(keys(rows=2001), 101)
    assert sample.shape == (2001, 101) and bool(sample.isfinite().all())
    assert_mean(sample, 0.0, 1.0)
    assert_mean(sample**2, 1.0, math.sqrt(2))
    assert_mean(sample**4, 3.0, math.sqrt(96))
    assert_mean((sample.abs() > 2).float(), math.erfc(math.sqrt(2)), 0.21)
    # Numbers of one row come from neighbouring hashes: they must not be correlated.
    assert_mean(sample[:, :50] * sample[:, 51:], 0.0, 1.0)


def test_integers_include_both_ends_and_are_equally_likely():
    sample = random.integers(keys(rows=2000), 100, -2, 4)
    assert sample.unique().tolist() == list(range(-2, 5))
    for value in range(-2, 5):
        assert_mean((sample == value).float(), 1 / 7, math.sqrt(6) / 7)
    assert bool((random.integers(keys(), 9, 3, 3) == 3).all())
    per_row = random.integers(
        keys(), 50, torch.zeros(4, 1, dtype=torch.int64), torch.arange(4)[:, None]
    )
    assert bool((per_row <= torch.arange(4)[:, None]).all()) and int(per_row[3].max()) == 3


@pytest.mark.parametrize("along", ["rows", "indices", "counters", "streams", "seeds"])
def test_neighbours_are_independent(along):
    if along == "rows":
        sample = random.uniform(keys(rows=4000), 50)
    elif along == "indices":
        sample = random.uniform(keys(rows=50), 4000).T
    else:
        name = {"counters": "counter", "streams": "stream", "seeds": "seed"}[along]
        sample = torch.stack(
            [random.uniform(keys(rows=50, **{name: i}), 1)[:, 0] for i in range(4000)]
        )
    centred = sample - 0.5
    for distance in (1, 2, 64):
        assert_mean(centred[:-distance] * centred[distance:], 0.0, 1 / 12)


def test_rows_and_counters_do_not_trade_places():
    """Row i at count j and row j at count i are different draws."""
    counters = torch.stack(
        [random.uniform(keys(counter=count, rows=64), 1)[:, 0] for count in range(64)]
    )
    off_diagonal = ~torch.eye(64, dtype=torch.bool)
    assert not (counters == counters.T)[off_diagonal].any()
    assert counters.unique().numel() > 0.999 * counters.numel()


def test_stream_ids_are_stable_and_distinct():
    assert random.stream_id("a") == 0xE8B7BE43 & 0x7FFFFFFF
    assert len({random.stream_id(f"stream {i}") for i in range(2000)}) == 2000


def test_it_compiles_without_a_graph_break_to_the_same_numbers():
    def draw(counter):
        keys = random.row_keys(SEED, 3, counter, 8)
        return random.uniform(keys, 5), random.normal(keys, 5), random.integers(keys, 5, 0, 9)

    compiled = torch.compile(draw, fullgraph=True, backend="eager")
    for eager, other in zip(draw(zero(4)), compiled(zero(4)), strict=True):
        assert torch.equal(eager, other)


@pytest.mark.parametrize(
    "counter_E",
    [
        torch.zeros(3, dtype=torch.int64),
        torch.zeros(4, dtype=torch.int32),
        torch.zeros(1, 4).long(),
    ],
)
def test_counters_that_would_be_misread_are_refused(counter_E):
    with pytest.raises(
        ValueError, match=r"expected torch.int64, and a counter of shape \(\) or \(4,\)"
    ):
        random.uniform(random.row_keys(SEED, 1, counter_E, 4), 2)


@pytest.mark.parametrize(("low", "high"), [(5, 2), (0, 2**31)])
def test_ranges_of_integers_are_checked(low, high):
    with pytest.raises(ValueError, match=f"low={low}, high={high}"):
        random.integers(keys(), 3, low, high)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5, 7, 64, 65, 1000, 2**16, 98304])
def test_a_permutation_has_each_number_once(n):
    drawn = random.permutations(keys(rows=3), n)
    assert torch.equal(drawn.sort().values, torch.arange(3 * n).view(3, n))
    again, other = (random.permutations(keys(rows=3, counter=counter), n) for counter in (0, 1))
    assert torch.equal(drawn, again)
    if n > 60:
        assert (drawn == other).sum() < 20, (
            "as many numbers are where they were as in orders drawn apart: 3 in the mean"
        )
        assert (drawn[0] == drawn[1] - n).sum() < 20, "each row has an order of its own"


def exact_permutation(row: int, n: int, bits: int, rounds: int) -> list[int]:
    """Repeat the definition with Python's integers, from the bits that uniform draws show 24 of."""
    low_bits = bits // 2
    masks = (1 << low_bits) - 1, (1 << (bits - low_bits)) - 1
    golden, stream, seed = 0x9E3779B9, 1, 5
    base = mix(seed ^ stream)
    first = mix(base) ^ mix(row + 1)
    second = mix((first + row * golden + golden) & MASK) ^ mix(stream)
    round_keys = [
        mix(mix(mix(first) ^ ((i + 1) * golden & MASK)) ^ mix(second)) for i in range(rounds)
    ]

    def through(number: int) -> int:
        low, high = number & masks[0], number >> low_bits
        for i in range(0, rounds, 2):
            low ^= mix(high ^ round_keys[i]) & masks[0]
            high ^= mix(low ^ round_keys[i + 1]) & masks[1]
        return high << low_bits | low

    numbers = []
    for i in range(n):
        number = through(i)
        while number >= n:
            number = through(number)
        numbers.append(row * n + number)
    return numbers


@pytest.mark.parametrize(
    ("n", "bits", "rounds"), [(3, 2, 24), (50, 6, 24), (100, 7, 8), (1000, 10, 8)]
)
def test_a_permutation_is_the_network_that_it_says_it_is(n, bits, rounds):
    assert random.permutations(keys(), n).tolist() == [
        exact_permutation(row, n, bits, rounds) for row in range(4)
    ]


@pytest.mark.parametrize("n", [5, 12, 40, 100])
def test_pairs_of_a_permutation_are_equally_likely(n):
    rows = 20_000
    drawn = random.permutations(keys(rows=rows), n) % n
    expected = rows / (n * (n - 1))
    for first, second in ((0, 1), (0, n - 1), (n // 2, n // 2 + 1)):
        counts = torch.bincount(drawn[:, first] * n + drawn[:, second], minlength=n * n).view(n, n)
        assert not counts.diagonal().any()
        freedom = n * (n - 1) - 1
        chi_square = float(((counts - expected) ** 2).sum() / expected) - n * expected
        assert abs(chi_square - freedom) < 4.5 * math.sqrt(2 * freedom), (first, second)
