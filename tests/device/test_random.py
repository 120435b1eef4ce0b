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
    [(0, 0, 0), (5, 1, 3), (2**31 - 1, 2**31 - 1, 2**31), (2**62 + 12345, 77, 2**40 + 9), (1, 2, 2**32 - 1)],
)
def test_it_is_the_hash_that_it_says_it_is(seed, stream, counter):
    drawn = random.uniform(random.row_keys(torch.tensor(seed), stream, torch.tensor(counter), 3), 5)
    expected = [[exact_uniform(seed, stream, row, counter, index) for index in range(5)] for row in range(3)]
    assert drawn.tolist() == expected


def test_same_coordinates_same_numbers():
    assert torch.equal(random.uniform(keys(), 7), random.uniform(keys(), 7))
    assert torch.equal(random.normal(keys(), 7), random.normal(keys(), 7))


@pytest.mark.parametrize("other", [{"stream": 2}, {"counter": 1}, {"seed": 6}])
def test_each_coordinate_matters(other):
    assert not (random.uniform(keys(), 64) == random.uniform(keys(**other), 64)).any()


def test_a_row_does_not_depend_on_the_others():
    one_E, other_E = torch.tensor([3, 0, 8, 1]), torch.tensor([3, 5, 8, 2])
    one, other = (random.uniform(random.row_keys(SEED, 1, counter_E, 4), 6) for counter_E in (one_E, other_E))
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
    per_row = random.integers(keys(), 50, torch.zeros(4, 1, dtype=torch.int64), torch.arange(4)[:, None])
    assert bool((per_row <= torch.arange(4)[:, None]).all()) and int(per_row[3].max()) == 3


@pytest.mark.parametrize("along", ["rows", "indices", "counters", "streams", "seeds"])
def test_neighbours_are_independent(along):
    if along == "rows":
        sample = random.uniform(keys(rows=4000), 50)
    elif along == "indices":
        sample = random.uniform(keys(rows=50), 4000).T
    else:
        name = {"counters": "counter", "streams": "stream", "seeds": "seed"}[along]
        sample = torch.stack([random.uniform(keys(rows=50, **{name: i}), 1)[:, 0] for i in range(4000)])
    centred = sample - 0.5
    for distance in (1, 2, 64):
        assert_mean(centred[:-distance] * centred[distance:], 0.0, 1 / 12)


def test_rows_and_counters_do_not_trade_places():
    """Row i at count j and row j at count i are different draws."""
    counters = torch.stack([random.uniform(keys(counter=count, rows=64), 1)[:, 0] for count in range(64)])
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
    [torch.zeros(3, dtype=torch.int64), torch.zeros(4, dtype=torch.int32), torch.zeros(1, 4).long()],
)
def test_counters_that_would_be_misread_are_refused(counter_E):
    with pytest.raises(ValueError, match=r"expected torch.int64, and a counter of shape \(\) or \(4,\)"):
        random.uniform(random.row_keys(SEED, 1, counter_E, 4), 2)


@pytest.mark.parametrize(("low", "high"), [(5, 2), (0, 2**31)])
def test_ranges_of_integers_are_checked(low, high):
    with pytest.raises(ValueError, match=f"low={low}, high={high}"):
        random.integers(keys(), 3, low, high)
