"""Whole training runs with the tasks' own settings: each must reach the return that counts as solved."""

import pytest

from ksim_rl import conf
from ksim_rl.trainers import build


@pytest.mark.full
@pytest.mark.parametrize("name", ["cartpole_balance", "cartpole_swingup"])
def test_a_task_is_solved(name):
    trainer = build(conf.compose([f"task={name}", "device=cpu", "logger=none"]))
    outcome = trainer.train()
    assert outcome.solved, outcome
    assert outcome.evaluation is not None and outcome.evaluation.episodes == 100
