import pytest
import torch

from ksim_rl.objectives import adapt_learning_rate_
from ksim_rl.testing import count_syncs


@pytest.mark.parametrize(
    ("kl", "lr", "expected"),
    [
        (0.0201, 1e-3, 1e-3 / 1.5),
        (0.0199, 1e-3, 1e-3),
        (0.01, 1e-3, 1e-3),
        (0.0051, 1e-3, 1e-3),
        (0.0049, 1e-3, 1.5e-3),
        (0.0, 1e-3, 1e-3),
        (1.0, 1.2e-5, 1e-5),
        (1e-4, 9e-3, 1e-2),
        (float("nan"), 1e-3, 1e-3),
        (float("inf"), 1e-3, 1e-3 / 1.5),
        (-1e-9, 1e-3, 1e-3),
    ],
)
def test_rule(kl, lr, expected):
    rate = torch.tensor(lr)
    out = adapt_learning_rate_(rate, torch.tensor(kl), desired_kl=0.01)
    assert out is rate
    assert rate.item() == pytest.approx(expected, rel=1e-6)


def test_factor_and_bounds_are_options():
    rate = torch.tensor(1.0)
    adapt_learning_rate_(
        rate, torch.tensor(9.0), desired_kl=1.0, factor=4.0, lr_min=0.3, lr_max=2.0
    )
    assert rate.item() == pytest.approx(0.3)
    adapt_learning_rate_(
        rate, torch.tensor(0.1), desired_kl=1.0, factor=9.0, lr_min=0.3, lr_max=2.0
    )
    assert rate.item() == pytest.approx(2.0)


def test_no_host_sync():
    rate, kl = torch.tensor(1e-3), torch.tensor(0.5)
    with count_syncs() as syncs:
        adapt_learning_rate_(rate, kl, desired_kl=0.01)
    assert syncs.total == 0, syncs.report()
