"""Exact moments; `test_observation_normalizer` and `test_normalization` hold the rest, with several ranks too."""

import pytest
import torch

from ksim_rl.ranks.running_moments import RunningMoments, publish


def test_merged_batches_equal_two_passes():
    batches = [
        torch.randn(n, 2) * torch.tensor([1e-3, 30.0]) + torch.tensor([1e3, -1.0])
        for n in (1, 7, 500)
    ]
    moments, seen = RunningMoments(2), torch.cat(batches).double()
    for batch in batches:
        moments.update(batch)
    torch.testing.assert_close(moments.exact_mean, seen.mean(0), rtol=1e-12, atol=0)
    variance = moments.exact_sum_of_squares / moments.count
    torch.testing.assert_close(variance, seen.var(0, unbiased=False), rtol=1e-8, atol=0)


def test_rows_that_are_not_finite_do_not_count():
    moments = RunningMoments(1)
    moments.update(torch.tensor([[1.0], [torch.nan], [3.0], [torch.inf]]))
    assert (int(moments.count), moments.mean.item(), moments.var.item()) == (2, 2.0, 1.0)


@pytest.mark.parametrize("until", [None, 40])
def test_rows_of_another_one_count_as_if_they_were_read(until):
    first, second = torch.randn(30, 2) + 5.0, 3.0 * torch.randn(12, 2)
    seen, other, read = RunningMoments(2, until=until), RunningMoments(2), RunningMoments(2)
    other.count_rows(second)
    for moments in (seen, read):
        moments.count_rows(first)
    for _ in range(3):
        seen.count_again(other)
    # A limit that is reached by the first time ends the others.
    for _ in range(3 if until is None else 1):
        read.count_rows(second)
    assert int(seen.count) == int(read.count)
    torch.testing.assert_close(seen.exact_mean, read.exact_mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(
        seen.exact_sum_of_squares, read.exact_sum_of_squares, rtol=1e-12, atol=1e-12
    )


def test_counted_rows_show_once_they_are_published():
    moments = RunningMoments(1)
    moments.count_rows(torch.tensor([[1.0], [3.0]]))
    assert (moments.mean.item(), moments.var.item()) == (0.0, 1.0)
    publish([moments])
    assert (moments.mean.item(), moments.var.item()) == (2.0, 1.0)


@pytest.mark.parametrize("num_rows", [1, 17, 9000])
def test_rows_in_many_parts_equal_two_passes(num_rows):
    rows = torch.randn(num_rows, 3) * torch.tensor([1.0, 1e-2, 1e3]) + torch.tensor(
        [0.0, 1e4, -1e3]
    )
    rows[num_rows // 2, 1] = torch.nan
    valid = torch.rand(num_rows) < 0.8
    moments = RunningMoments(3)
    for _ in range(2):
        moments.update(rows, valid)
    seen = rows[valid & rows.isfinite().all(-1)].double()
    assert int(moments.count) == 2 * len(seen)
    mean = seen.mean(0) if len(seen) else torch.zeros(3)
    torch.testing.assert_close(moments.exact_mean, mean, rtol=1e-12, atol=1e-12, check_dtype=False)
    squares = 2 * (seen - mean).square().sum(0)
    torch.testing.assert_close(
        moments.exact_sum_of_squares, squares, rtol=1e-10, atol=0, check_dtype=False
    )
