"""The ceiling of an annealed learning rate falls to zero with what is left of a run; no other rate changes."""

from typing import Any

import pytest
import torch

from ksim_rl.objectives import PPOCfg, anneal_learning_rate_, make_optimizer
from ksim_rl.objectives.gradient_step import rate_bounds
from ksim_rl.testing import count_syncs


def optimizer(cfg):
    return make_optimizer(cfg, torch.nn.Linear(2, 1))


@pytest.mark.parametrize(
    ("schedule", "done", "bounds", "rate"),
    [
        ("adaptive", 0.0, (1e-4, 8e-3), 4e-3),
        ("adaptive", 0.75, (1e-4, 2e-3), 2e-3),
        ("adaptive", 0.99, (8e-5, 8e-5), 8e-5),
        ("adaptive", 1.0, (0.0, 0.0), 0.0),
        ("fixed", 0.0, (4e-3, 4e-3), 4e-3),
        ("fixed", 0.75, (1e-3, 1e-3), 1e-3),
        ("fixed", 1.0, (0.0, 0.0), 0.0),
    ],
)
def test_bounds_and_rate_after_a_share_of_the_run(schedule, done, bounds, rate):
    limits: Any = {"learning_rate_min": 1e-4, "learning_rate_max": 8e-3}
    cfg = PPOCfg(learning_rate=4e-3, schedule=schedule, anneal_learning_rate=True, **limits)
    made = optimizer(cfg)
    kept, held = made.param_groups[0]["lr"], rate_bounds(cfg, made)
    with count_syncs() as syncs:
        anneal_learning_rate_(cfg, made, done=done)
    assert syncs.total == 0, syncs.report()
    # In place, where captured graphs read them.
    assert made.param_groups[0]["lr"] is kept and rate_bounds(cfg, made) is held
    torch.testing.assert_close(held, torch.tensor(bounds))
    assert kept.item() == pytest.approx(rate, rel=1e-6)


def test_a_run_that_is_given_more_iterations_leaves_zero():
    cfg = PPOCfg(anneal_learning_rate=True)
    made = optimizer(cfg)
    anneal_learning_rate_(cfg, made, done=1.0)
    anneal_learning_rate_(cfg, made, done=0.5)
    assert made.param_groups[0]["lr"].item() == pytest.approx(cfg.learning_rate_min)


@pytest.mark.parametrize("done", [-0.1, 1.1, float("nan")])
@pytest.mark.parametrize("annealed", [True, False])
def test_what_is_no_share_is_refused(done, annealed):
    cfg = PPOCfg(anneal_learning_rate=annealed)
    with pytest.raises(ValueError, match=r"done=.*in \[0, 1\]"):
        anneal_learning_rate_(cfg, optimizer(cfg), done=done)


@pytest.mark.parametrize("schedule", ["adaptive", "fixed"])
def test_without_the_option_nothing_changes(schedule):
    cfg = PPOCfg(learning_rate=4e-3, schedule=schedule)
    made = optimizer(cfg)
    # As a hook of a user may set it.
    made.param_groups[0]["lr"].fill_(0.5)
    anneal_learning_rate_(cfg, made, done=0.9)
    assert made.param_groups[0]["lr"].item() == 0.5
    assert "lr_bounds" not in made.param_groups[0]
