"""One RL update: no host sync, no step on what is not finite, statistics counted once."""

import pytest
import torch

from ksim_rl.testing import count_syncs
from tests.trainers.target_env import make_trainer


@pytest.fixture
def trainer():
    return make_trainer()


def learned(update):
    return {name: parameter.detach().clone() for name, parameter in update.actor.named_parameters()}


def test_an_iteration_makes_no_host_sync(trainer):
    for _ in range(2):  # the first allocates
        trainer.update(trainer.collector.collect())
    with count_syncs() as syncs:
        trainer.update(trainer.collector.collect())
        trainer.update.metrics()
    # Fused Adam reads its learning rate in C++ on CPU, which is no sync on a GPU.
    assert syncs.total == 0, syncs.report()


def test_metrics_are_means_over_the_gradient_steps(trainer):
    trainer.update(trainer.collector.collect())
    metrics = {name: value.item() for name, value in trainer.update.metrics().items()}
    assert metrics["update/skipped_steps"] == 0
    # Entropy of a gaussian with std 0.5: 0.5 ln(2 pi e 0.25) = 0.726; it moves little in one update.
    assert metrics["loss/entropy"] == pytest.approx(0.726, abs=0.1)
    assert 0.0 <= metrics["update/clip_fraction"] <= 1.0
    assert 0.0 < metrics["update/kl"] < 1.0


def test_an_env_state_with_a_non_finite_reward_is_left_out_and_counted(trainer):
    trainer.update(trainer.collector.collect())
    rollout_ET = trainer.collector.collect()
    rollout_ET["next", "reward"][0, 5] = float("nan")
    trainer.update(rollout_ET)
    assert trainer.update.metrics()["update/non_finite_env_states"] == 1
    assert all(value.isfinite().all() for value in learned(trainer.update).values())
    assert trainer.update.metrics()["update/skipped_steps"] == 0


def test_a_non_finite_loss_changes_no_parameter_and_does_not_spoil_the_means(trainer):
    trainer.update(trainer.collector.collect())
    before = learned(trainer.update)
    with torch.no_grad():
        next(trainer.update.critic.parameters()).fill_(float("nan"))
    trainer.update(trainer.collector.collect())
    after = learned(trainer.update)
    assert all(torch.equal(before[name], after[name]) for name in before)
    metrics = trainer.update.metrics()
    assert metrics["update/skipped_in_a_row"] == 16
    assert all(value.isfinite() for value in metrics.values())


def test_observation_statistics_count_each_env_state_once(trainer):
    for _ in range(3):
        trainer.update(trainer.collector.collect())
    normalizer = next(
        module
        for module in trainer.update.critic.modules()
        if type(module).__name__ == "ObservationNormalizer"
    )
    assert normalizer.count == 3 * 256


def test_loading_keeps_addresses_for_captured_graphs(trainer):
    trainer.update(trainer.collector.collect())
    addresses = [parameter.data_ptr() for parameter in trainer.update.actor.parameters()]
    learning_rate = trainer.update.optimizer.param_groups[0]["lr"]
    state = make_trainer(seed=4).update.state_dict()
    trainer.update.load_state_dict(state)
    assert [parameter.data_ptr() for parameter in trainer.update.actor.parameters()] == addresses
    assert trainer.update.optimizer.param_groups[0]["lr"] is learning_rate


def test_an_optimizer_of_another_size_is_refused(trainer):
    trainer.update(trainer.collector.collect())
    state = trainer.update.state_dict()
    state["optimizer"]["moments"].popitem()
    with pytest.raises(
        ValueError, match=r"optimizer: \d+ parameters in the checkpoint, \d+ in this run"
    ):
        trainer.update.load_state_dict(state)


@pytest.mark.parametrize(
    ("ppo", "estimates"),
    [
        ({}, 1),
        ({"estimate_each_epoch": True}, 4),
        ({"advantage": "td_lambda"}, 1),
        ({"advantage": "vtrace"}, 4),
    ],
    ids=str,
)
def test_advantages_are_estimated_once_or_before_each_epoch(ppo, estimates, monkeypatch):
    trainer = make_trainer(ppo=ppo)
    rollout_ET = trainer.collector.collect()
    rollout_ET["next", "reward"][0, 5] = float("nan")
    targets = []
    forward = type(trainer.update.advantage).forward

    def watched(self, *args, **kwargs):
        out = forward(self, *args, **kwargs)
        targets.append(out["value_target"].clone())
        return out

    monkeypatch.setattr(type(trainer.update.advantage), "forward", watched)
    trainer.update(rollout_ET)
    assert len(targets) == estimates
    # Each with the present networks; the env state that is not finite is counted once.
    assert all(
        not torch.equal(one, other) for one, other in zip(targets, targets[1:], strict=False)
    )
    assert trainer.update.metrics()["update/non_finite_env_states"] == 1
    with count_syncs() as syncs:
        trainer.update(rollout_ET)
    assert syncs.total == 0, syncs.report()


# The divergence is always small, or always large, beside these: the rate is at its ceiling, or at its floor.
UP, DOWN = {"desired_kl": 1e3}, {"desired_kl": 1e-12}


@pytest.mark.parametrize("ppo", [UP, DOWN, {"schedule": "fixed"}], ids=str)
def test_annealing_at_the_start_of_a_run_changes_no_bit(ppo):
    limits = {"learning_rate_min": 1e-3, "learning_rate_max": 5e-3}
    plain, annealed = (
        make_trainer(ppo={**ppo, **limits, "anneal_learning_rate": anneals})
        for anneals in (False, True)
    )
    for trainer in (plain, annealed):
        torch.manual_seed(1)
        for _ in range(2):
            # It makes no difference to one that is not annealed.
            trainer.update.set_progress(0.0 if trainer is annealed else 0.9)
            trainer.update(trainer.collector.collect())
    ours, theirs = (learned(trainer.update) for trainer in (plain, annealed))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    rates = [trainer.update.metrics()["update/learning_rate"] for trainer in (plain, annealed)]
    assert torch.equal(*rates)


@pytest.mark.parametrize(
    ("ppo", "rates"),
    [
        (UP, (4e-3, 2e-3, 1e-3)),
        (DOWN, (1.5e-3, 1.5e-3, 1e-3)),
        ({"schedule": "fixed"}, (3e-3, 1.5e-3, 7.5e-4)),
    ],
    ids=str,
)
def test_gradient_steps_keep_to_the_bounds_of_their_share_of_the_run(ppo, rates):
    limits = {"learning_rate_min": 1.5e-3, "learning_rate_max": 4e-3}
    trainer = make_trainer(ppo={**ppo, **limits, "anneal_learning_rate": True})
    for done, rate in zip((0.0, 0.5, 0.75), rates, strict=True):
        trainer.update.set_progress(done)
        trainer.update(trainer.collector.collect())
        assert trainer.update.metrics()["update/learning_rate"].item() == pytest.approx(
            rate, rel=1e-6
        )
    with pytest.raises(ValueError, match="share of the run"):
        trainer.update.set_progress(1.5)
