"""Means over ranks are those over all rows that take part, however these are spread."""

import pytest
import torch

from ksim_rl import ranks
from ksim_rl.objectives import gradient_step
from ksim_rl.objectives.masked import masked_mean
from tests.ranks.gloo import results

ROWS, WIDTH = 8, 3


def step(num_taking_part):
    """Step down the gradient of a mean over this rank's rows, or all; return the loss, and where the step led."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(len(num_taking_part), ROWS, WIDTH, generator=generator)
    mask = torch.arange(ROWS) < torch.tensor(num_taking_part)[:, None]
    rows[~mask] = torch.nan
    if ranks.size() > 1:
        rows, mask = rows[ranks.rank()], mask[ranks.rank()]
    weight = torch.nn.Parameter(torch.ones(WIDTH))
    loss = masked_mean((rows @ weight).square(), mask)
    optimizer = torch.optim.SGD([weight], lr=1.0, fused=True)
    gradient_step.go_back({"loss": loss}, {"loss": optimizer}, mask=mask)
    gradient_step.step(optimizer, loss, max_grad_norm=None)
    return loss.detach(), weight.detach()


@pytest.mark.parametrize("num_taking_part", [(8, 8), (8, 3), (5, 0), (0, 0)])
def test_a_rank_counts_by_its_rows_that_take_part(num_taking_part, tmp_path):
    expected = step(num_taking_part)
    for found in results(step, num_taking_part, size=2, folder=tmp_path):
        torch.testing.assert_close(found, expected)


def reduced():
    mine = torch.tensor([1.0, 2.0]) * (1 + ranks.rank())
    summed, exact, counted = mine.clone(), mine.double(), torch.tensor(ranks.rank())
    ranks.sum_(summed)
    ranks.sum_(counted)
    once = mine.clone()
    ranks.mean_([once, exact, once], weight=torch.tensor(0.25 + 0.5 * ranks.rank()))
    return summed.tolist(), counted.item(), once.tolist(), exact.tolist()


def test_sums_and_means_of_several_dtypes_and_of_what_is_listed_twice(tmp_path):
    for found in results(reduced, size=2, folder=tmp_path):
        assert found == ([3.0, 6.0], 1, [1.75, 3.5], [1.75, 3.5])
