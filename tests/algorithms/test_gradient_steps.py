"""What the updates share: means over the steps that were made, and the end of a run that skips its steps."""

import pytest
import torch

from ksim_rl.algorithms.gradient_steps import RolloutUpdate, StepMeans, public_objects
from ksim_rl.compiled.python_values import Listed
from ksim_rl.compiled.python_watch import PythonWatch
from ksim_rl.objectives import NonFiniteStepsError
from tests.algorithms.imitation_problems import make_amp, make_distillation
from tests.algorithms.test_warm_up import PROBLEMS
from tests.trainers.target_env import make_trainer


def test_means_are_over_the_steps_that_were_made():
    means = StepMeans({"kl": "update/kl", "loss": "loss/policy"})
    skipped = torch.tensor([0.0, 1.0, 0.0])
    means.take_({"kl": torch.tensor([1.0, torch.nan, 3.0]), "skipped": skipped})
    assert means == {"update/kl": torch.tensor(2.0)}
    kept = means["update/kl"]
    means.take_({"kl": torch.full((3,), torch.nan), "skipped": torch.ones(3)})
    assert kept is means["update/kl"] and kept == 0.0


class Nothing(RolloutUpdate):
    def _update(self):
        pass


def test_the_limit_counts_all_steps_in_a_row():
    metrics = {"update/skipped_in_a_row": 4.0, "update/skipped_steps": 9.0}
    Nothing({}, max_skipped_steps=5, device="cpu", logged={}).check(metrics)
    with pytest.raises(
        NonFiniteStepsError, match="4 gradient steps in a row.*limit 4, 9 since the start"
    ):
        Nothing({}, max_skipped_steps=4, device="cpu", logged={}).check(metrics)


def test_a_run_ends_even_if_steps_are_made_after_those_in_a_row():
    trainer = make_trainer(ppo={"max_skipped_steps": 5})
    update = trainer.update
    steps, losses = 0, update._losses

    def bad_at_first(minibatch_B):
        nonlocal steps
        steps += 1
        out = losses(minibatch_B)
        return out.set("loss_critic", out["loss_critic"] * torch.nan) if steps <= 5 else out

    update._losses = bad_at_first
    update(trainer.collector.collect())
    assert update.guard.skipped == 5 and update.guard.skipped_in_a_row == 0
    with pytest.raises(NonFiniteStepsError, match="5 gradient steps in a row"):
        update.check({name: value.item() for name, value in update.metrics().items()})


@pytest.mark.parametrize("make", [make_amp, make_distillation])
def test_amp_and_distillation_anneal_the_rate_of_the_policy_too(make):
    cfg = {"learning_rate": 3e-3, "schedule": "fixed", "anneal_learning_rate": True}
    trainer = make(iterations=3, num_envs=16, cfg=cfg)
    trainer.train()
    assert trainer.metrics["update/learning_rate"] == pytest.approx(1e-3, rel=1e-6)
    # As a user's own loop may go on.
    trainer.iterate()
    assert trainer.metrics["update/learning_rate"] == 0.0
    if make is make_amp:  # whose discriminator has a rate of its own
        assert trainer.update.optimizer.param_groups[0]["lr"].item() == pytest.approx(1e-3)


@pytest.mark.parametrize("name", PROBLEMS)
def test_an_iteration_changes_no_python_value_that_graphs_are_recorded_from(name):
    trainer = PROBLEMS[name]()
    update, policy = trainer.update, trainer.collector.policy
    parts = {"update": Listed(update, lambda: public_objects(update)), "policy": policy}
    watch = PythonWatch(torch.device("cpu"))
    for _ in range(2):
        trainer.iterate()
    watch.look(parts)
    for _ in range(2):
        trainer.iterate()
    trainer.settle()
    assert list(map(str, watch.changes())) == []
    (next(iter(update.networks.values()))).train(False)
    assert any("training was True and is False" in str(change) for change in watch.changes())
