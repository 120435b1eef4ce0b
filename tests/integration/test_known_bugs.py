"""Bugs that the field knows: a check for each passes on our parts, and fails once the bug is put in.

Two more have their tests where the part is: memory that leaks over a reset (recurrent networks), and a standard
deviation that grows through tanh (squashed gaussians).
"""

import importlib

import pytest
import torch

from ksim_rl.algorithms import gradient_steps as gradient_steps_module
from ksim_rl.algorithms.ppo import update as ppo_update_module
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import EpochSampler
from ksim_rl.modules import ObservationNormalizer
from ksim_rl.objectives.clip_ppo_loss import ClipPPOLoss
from ksim_rl.objectives.rollout_estimator import RolloutEstimator, Signals
from tests.integration.probes import GAMMA, E, ProbeEnv, Run, T, one, sign_only, the_sign

# The package has a function of the same name.
ppo_step_module = importlib.import_module("ksim_rl.objectives.ppo_step")
ESTIMATORS = ("gae", "td_lambda", "vtrace")


def _targets(*, truncates, advantage):
    """Return a rollout with value targets and V(s) = 3 sign, which is what no reset state says of another episode."""
    run = Run(ProbeEnv(sign_only, the_sign, length=3, truncates=truncates), advantage=advantage)
    with torch.no_grad():
        layers = [
            module for module in run.update.critic.modules() if isinstance(module, torch.nn.Linear)
        ]
        for layer in layers:
            layer.weight.zero_(), layer.bias.zero_()
        # ELU(x) - ELU(-x) is odd, and 1.632 at 1.
        layers[0].weight[0, 0], layers[0].weight[1, 0] = 1.0, -1.0
        layers[-1].weight[0, 0], layers[-1].weight[0, 1] = 1.0, -1.0
        scale = 3.0 / run.values(0)
        layers[-1].weight.mul_(scale)
    rollout_ET = run.update.advantage(run.collector.collect())
    return rollout_ET, rollout_ET["next", "done"]


def check_truncation(advantage):
    """The target of a truncated step is its reward and the value of the state that was reached."""
    rollout_ET, done_ET = _targets(truncates=True, advantage=advantage)
    sign = rollout_ET["actor"][done_ET.squeeze(-1)]
    torch.testing.assert_close(
        rollout_ET["value_target"][done_ET.squeeze(-1)], sign + GAMMA * 3.0 * sign
    )


def check_termination(advantage):
    """The target of a terminated step is its reward alone."""
    rollout_ET, done_ET = _targets(truncates=False, advantage=advantage)
    sign = rollout_ET["actor"][done_ET.squeeze(-1)]
    torch.testing.assert_close(rollout_ET["value_target"][done_ET.squeeze(-1)], sign)


def check_no_leak_between_episodes(advantage):
    """No target depends on what the next episode pays."""
    rollout_ET, done_ET = _targets(truncates=True, advantage=advantage)
    estimator = Run(
        ProbeEnv(sign_only, the_sign, length=3, truncates=True), advantage=advantage
    ).update.advantage
    targets = []
    for bonus in (0.0, 100.0):
        changed = rollout_ET.clone()
        first_end = int(done_ET[0, :, 0].to(torch.int64).argmax())
        changed["next", "reward"][0, first_end + 1 :] += bonus
        targets.append(estimator(changed)["value_target"][0, : first_end + 1])
    torch.testing.assert_close(targets[0], targets[1])


@pytest.mark.parametrize("advantage", ESTIMATORS)
def test_bootstrap_from_the_reset_observation(advantage, monkeypatch):
    check_truncation(advantage)
    collect = RolloutCollector.collect

    def buggy(self):
        rollout_ET = collect(self)
        # What a vectorized env gives that overwrites the last observation of an episode by the first of the next.
        rollout_ET["next", "critic"][:, :-1] = rollout_ET["critic"][:, 1:].clone()
        return rollout_ET

    monkeypatch.setattr(RolloutCollector, "collect", buggy)
    with pytest.raises(AssertionError):
        check_truncation(advantage)


@pytest.mark.parametrize("advantage", ESTIMATORS)
def test_bootstrap_after_a_termination(advantage, monkeypatch):
    check_termination(advantage)
    monkeypatch.setattr(Signals, "bootstrap", lambda self, value, gamma: gamma * value)
    with pytest.raises(AssertionError):
        check_termination(advantage)


@pytest.mark.parametrize("advantage", ESTIMATORS)
def test_returns_that_leak_over_the_end_of_an_episode(advantage, monkeypatch):
    check_no_leak_between_episodes(advantage)
    signals = RolloutEstimator._signals

    def buggy(self, *args):
        found = signals(self, *args)
        # "time is up" is taken for "goes on".
        object.__setattr__(found, "done_ET", found.terminated_ET)
        return found

    monkeypatch.setattr(RolloutEstimator, "_signals", buggy)
    with pytest.raises(AssertionError):
        check_no_leak_between_episodes(advantage)


def _normalizers(update):
    modules = (*update.actor.modules(), *update.critic.modules())
    return [module for module in modules if isinstance(module, ObservationNormalizer)]


def check_normalizers_count_once():
    """The statistics count each env state collected, and each once."""
    run = Run(ProbeEnv(sign_only, the_sign, length=3), normalized=True)
    seen = []
    for _ in range(2):
        rollout_ET = run.collector.collect()
        seen.append(rollout_ET["actor"].clone())
        run.update(rollout_ET)
    seen = torch.cat(seen)
    normalizers = _normalizers(run.update)
    assert len(normalizers) == 2
    for normalizer in normalizers:
        assert normalizer.count == 2 * E * T
        torch.testing.assert_close(normalizer.mean, seen.mean((0, 1)), atol=1e-5, rtol=1e-5)


def test_a_normalizer_that_counts_twice(monkeypatch):
    check_normalizers_count_once()
    update_normalizers = ppo_update_module.update_normalizers

    def buggy(*args, **kwargs):
        update_normalizers(*args, **kwargs)
        update_normalizers(*args, **kwargs)

    monkeypatch.setattr(ppo_update_module, "update_normalizers", buggy)
    with pytest.raises(AssertionError):
        check_normalizers_count_once()


def check_the_first_step_sees_the_policy_that_collected(monkeypatch):
    """Before the first gradient step the ratio is 1 for each env state, as its policy is the one that collected."""
    run = Run(ProbeEnv(sign_only, the_sign, length=3), normalized=True)
    run.iterate(1)
    divergences = []
    step = gradient_steps_module.ppo_step

    def watched(*args, **kwargs):
        result = step(*args, **kwargs)
        divergences.append((float(result["kl"]), float(result["clip_fraction"])))
        return result

    with monkeypatch.context() as patch:
        patch.setattr(gradient_steps_module, "ppo_step", watched)
        run.iterate(1)
    assert divergences[0] == (pytest.approx(0.0, abs=1e-6), 0.0)
    assert divergences[-1][0] > 1e-5


def test_a_normalizer_that_moves_before_the_gradient_steps(monkeypatch):
    check_the_first_step_sees_the_policy_that_collected(monkeypatch)
    forward = RolloutEstimator.forward

    def buggy(self, tensordict, **kwargs):
        for normalizer in run_normalizers:
            normalizer.update(tensordict["actor"] * 3.0 + 1.0)
        return forward(self, tensordict, **kwargs)

    run_normalizers = []
    make = ppo_update_module.PPOUpdate.__init__

    def remember(self, *args, **kwargs):
        make(self, *args, **kwargs)
        run_normalizers.extend(_normalizers(self))

    monkeypatch.setattr(RolloutEstimator, "forward", buggy)
    monkeypatch.setattr(ppo_update_module.PPOUpdate, "__init__", remember)
    with pytest.raises(AssertionError):
        check_the_first_step_sees_the_policy_that_collected(monkeypatch)


def check_epochs_have_orders_of_their_own():
    """Each epoch covers the dataset exactly once, in another order than the one before."""
    run = Run(ProbeEnv(sign_only, the_sign, length=3))
    run.iterate(1)
    dataset = run.update.dataset
    rows = []
    for _ in range(3):
        minibatches = list(dataset.epoch())
        rows.append(torch.cat([minibatch_B["action_log_prob"] for minibatch_B in minibatches]))
    stored = dataset.all()["action_log_prob"].sort().values
    for row in rows:
        assert torch.equal(row.sort().values, stored)
    assert not torch.equal(rows[0], rows[1]) and not torch.equal(rows[1], rows[2])


@pytest.mark.parametrize("bug", ["one order for all epochs", "draws with replacement"])
def test_epochs_that_reuse_an_order(bug, monkeypatch):
    check_epochs_have_orders_of_their_own()
    if bug == "one order for all epochs":
        orders_of = lambda self, epochs, size: torch.randperm(  # noqa: E731
            size, generator=torch.Generator().manual_seed(0)
        ).expand(len(epochs), size)
    else:
        orders_of = lambda self, epochs, size: torch.randint(size, (len(epochs), size))  # noqa: E731
    monkeypatch.setattr(EpochSampler, "_orders", orders_of)
    with pytest.raises(AssertionError):
        check_epochs_have_orders_of_their_own()


def check_the_learning_rate_follows_the_divergence():
    """A policy that moves too far slows down, one that hardly moves speeds up."""
    for desired_kl, faster in ((1e-6, False), (10.0, True)):
        options = {"schedule": "adaptive", "desired_kl": desired_kl, "learning_rate": 1e-3}
        run = Run(ProbeEnv(sign_only, the_sign, length=1), **options).iterate(1)
        rate = float(run.update.optimizer.param_groups[0]["lr"])
        assert rate > 2e-3 if faster else rate < 0.5e-3


def test_an_adaptive_learning_rate_with_the_wrong_sign(monkeypatch):
    check_the_learning_rate_follows_the_divergence()
    adapt = ppo_step_module.adapt_learning_rate_

    def buggy(lr, kl, *, desired_kl, **kwargs):
        return adapt(lr, desired_kl**2 / kl, desired_kl=desired_kl, **kwargs)

    monkeypatch.setattr(ppo_step_module, "adapt_learning_rate_", buggy)
    with pytest.raises(AssertionError):
        check_the_learning_rate_follows_the_divergence()


def check_the_entropy_bonus_widens_the_policy():
    """Where all actions pay the same, only the entropy bonus moves the standard deviation: upwards."""
    run = Run(ProbeEnv(sign_only, one, length=1), entropy_coeff=0.1)
    run.iterate(2)
    assert run.update.metrics()["policy/std"] > 0.501


def test_an_entropy_bonus_with_the_wrong_sign(monkeypatch):
    check_the_entropy_bonus_widens_the_policy()
    weighted = ClipPPOLoss._weighted_loss_entropy
    monkeypatch.setattr(
        ClipPPOLoss, "_weighted_loss_entropy", lambda self, entropy: -weighted(self, entropy)
    )
    with pytest.raises(AssertionError):
        check_the_entropy_bonus_widens_the_policy()
