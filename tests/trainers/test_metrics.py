"""Metrics reach the host exactly, under their names."""

import torch

from ksim_rl.testing import count_syncs
from ksim_rl.trainers.metrics import start_copy

CPU = torch.device("cpu")


def test_values_keep_their_names_and_counts_stay_exact():
    metrics = {
        "count": torch.tensor(2**40 + 1),
        "mean": torch.tensor(0.5),
        "flag": torch.tensor(True),
    }
    assert start_copy(metrics, device=CPU).read() == {
        "count": 2.0**40 + 1,
        "mean": 0.5,
        "flag": 1.0,
    }


def test_no_metrics_are_no_metrics():
    assert start_copy({}, device=CPU).read() == {}


def test_the_copy_is_of_the_moment():
    value = torch.tensor(1.0)
    pending = start_copy({"value": value}, device=CPU)
    value.fill_(2.0)
    assert pending.read() == {"value": 1.0}


def test_starting_a_copy_does_not_wait_for_the_device():
    metrics = {str(number): torch.tensor(float(number)) for number in range(30)}
    with count_syncs() as syncs:
        pending = start_copy(metrics, device=CPU)
    assert syncs.total == 0, syncs.report()
    assert len(pending.read()) == 30
