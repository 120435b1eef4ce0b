import pytest
import torch

from ksim_rl.testing import count_syncs

X = torch.arange(6.0)
MASK = X > 2

SYNCS = {
    "item": lambda: X[0].item(),
    "float": lambda: float(X[0]),
    "int": lambda: int(X[0]),
    "bool": lambda: bool(MASK[0]),
    "if": lambda: 1 if MASK.any() else 0,
    "tolist": lambda: X.tolist(),
    "numpy": lambda: X.numpy(),
    "cpu": lambda: X.cpu(),
    "nonzero": lambda: MASK.nonzero(),
    "where_without_values": lambda: torch.where(MASK),
    "read_by_mask": lambda: X[MASK],
    "write_by_mask": lambda: X.clone().__setitem__(MASK, X[:3]),
    "masked_select": lambda: torch.masked_select(X, MASK),
    "equal": lambda: torch.equal(X, X),
    "allclose": lambda: torch.allclose(X, X),
    "unique": lambda: torch.unique(X),
    "unique_consecutive": lambda: torch.unique_consecutive(X),
    "linalg": lambda: torch.linalg.inv(torch.eye(2)),
    "bincount": lambda: torch.bincount(X.long()),
    "repeat_interleave": lambda: torch.repeat_interleave(X, X.long()),
    "from_python": lambda: torch.tensor([1.0, 2.0]),
    "other_device": lambda: X.to("meta"),
    "copy_between_devices": lambda: torch.empty(6, device="meta").copy_(X),
}
CLEAN = {
    "where": lambda: torch.where(MASK, X, 0.0),
    "index_by_integers": lambda: X[torch.arange(3)],
    "index_select": lambda: X.index_select(0, torch.arange(3)),
    "gather": lambda: X.gather(0, torch.arange(3)),
    "masked_fill": lambda: X.masked_fill(MASK, 0.0),
    "in_place": lambda: X.clone().copy_(X).add_(1).clamp_(0, 1),
    "reductions": lambda: (X.sum(), MASK.any(), MASK.all(), X.amax()),
    "same_device": lambda: X.to("cpu", torch.float64),
    "repeat_interleave_of_known_size": lambda: torch.repeat_interleave(X, X.long(), output_size=15),
    "factories": lambda: (torch.zeros(3), torch.full((2,), 1.0), torch.arange(4)),
}


@pytest.mark.parametrize("what", SYNCS)
def test_what_waits_for_the_device_is_counted(what):
    with count_syncs() as syncs:
        SYNCS[what]()
    assert syncs.total >= 1, what
    assert "test_sync_count.py" in syncs.report()


@pytest.mark.parametrize("what", CLEAN)
def test_what_does_not_wait_is_not_counted(what):
    with count_syncs() as syncs:
        CLEAN[what]()
    assert syncs.total == 0, syncs.report()
    assert syncs.report() == "no host sync"


def test_calls_are_counted_one_by_one_and_only_inside():
    X.sum().item()
    with count_syncs() as syncs:
        for _ in range(3):
            X.sum().item()
    X.sum().item()
    assert syncs.total == 3
    assert syncs.report().startswith("3 x ")
