"""Exact moments; `test_observation_normalizer` and `test_normalization` hold the rest, with several ranks too."""

import torch

from ksim_rl.device.running_moments import RunningMoments, publish


def test_merged_batches_equal_two_passes():
    batches = [
        torch.randn(n, 2) * torch.tensor([1e-3, 30.0]) + torch.tensor([1e3, -1.0]) for n in (1, 7, 500)
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


def test_counted_rows_show_once_they_are_published():
    moments = RunningMoments(1)
    moments.count_rows(torch.tensor([[1.0], [3.0]]))
    assert (moments.mean.item(), moments.var.item()) == (0.0, 1.0)
    publish([moments])
    assert (moments.mean.item(), moments.var.item()) == (2.0, 1.0)
