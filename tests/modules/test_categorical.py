import math

import pytest
import torch
from torch import distributions
from torch.distributions import kl_divergence
from torchrl.data import MultiCategorical, MultiOneHot, OneHot
from torchrl.modules import OneHotCategorical
from torchrl.modules.distributions.utils import has_analytic_entropy, has_analytic_kl

from ksim_rl.modules import Categorical
from ksim_rl.testing import count_syncs

SIZES = (2, 4, 3)


def _references(logits):
    return [distributions.Categorical(logits=part) for part in logits.split(SIZES, -1)]


def test_one_choice_equals_torch():
    logits = torch.randn(6, 4, 5)
    ours, reference = Categorical(logits), distributions.Categorical(logits=logits)
    value = reference.sample()
    torch.testing.assert_close(ours.log_prob(value), reference.log_prob(value))
    torch.testing.assert_close(ours.entropy(), reference.entropy())
    torch.testing.assert_close(ours.probs, reference.probs)
    assert torch.equal(ours.mode, reference.mode) and torch.equal(
        ours.deterministic_sample, ours.mode
    )
    assert ours.batch_shape == reference.batch_shape and ours.event_shape == reference.event_shape


def test_one_hot_equals_torchrl():
    logits = torch.randn(6, 5)
    ours, reference = Categorical(logits, one_hot=True), OneHotCategorical(logits=logits)
    value = reference.sample()
    torch.testing.assert_close(ours.log_prob(value), reference.log_prob(value))
    assert torch.equal(ours.mode.long(), reference.mode.long())
    sample = ours.sample()
    assert OneHot(5, shape=(6, 5)).is_in(sample)


@pytest.mark.parametrize("one_hot", [False, True])
def test_several_choices_are_independent_ones(one_hot):
    logits = torch.randn(7, sum(SIZES))
    ours, references = Categorical(logits, SIZES, one_hot), _references(logits)
    sample = ours.sample()
    spec = (
        MultiOneHot(SIZES, shape=(7, sum(SIZES)), dtype=torch.bool)
        if one_hot
        else MultiCategorical(SIZES, shape=(7, 3))
    )
    assert spec.is_in(sample)
    index = (
        torch.stack([part.long().argmax(-1) for part in sample.split(SIZES, -1)], -1)
        if one_hot
        else sample
    )
    expected = sum(reference.log_prob(index[:, k]) for k, reference in enumerate(references))
    torch.testing.assert_close(ours.log_prob(sample), expected)
    torch.testing.assert_close(ours.entropy(), sum(reference.entropy() for reference in references))


def test_divergence_equals_torchs():
    logits_p, logits_q = torch.randn(2, 7, sum(SIZES))
    expected = sum(map(kl_divergence, _references(logits_p), _references(logits_q)))
    p, q = Categorical(logits_p, SIZES), Categorical(logits_q, SIZES)
    torch.testing.assert_close(kl_divergence(p, q), expected)
    assert has_analytic_entropy(p) and has_analytic_kl(p, q)


def test_gradients_are_those_of_finite_differences():
    logits = torch.randn(4, sum(SIZES), dtype=torch.float64, requires_grad=True)
    value = Categorical(logits, SIZES).sample()
    assert torch.autograd.gradcheck(
        lambda logits: (
            Categorical(logits, SIZES).log_prob(value),
            Categorical(logits, SIZES).entropy(),
        ),
        logits,
    )


def test_samples_have_the_probabilities():
    torch.manual_seed(0)
    dist, count = Categorical(torch.tensor([0.0, 1.0, -3.0, 2.0, -9.0])), 100_000
    frequency = torch.bincount(dist.sample((count,)), minlength=5) / count
    tolerance = 4.0 * (dist.probs * (1.0 - dist.probs) / count).sqrt()
    assert ((frequency - dist.probs).abs() <= tolerance).all()


def test_an_option_ruled_out_is_never_chosen_and_makes_nothing_nan():
    logits = torch.tensor([0.3, -math.inf, 1.0], requires_grad=True)
    dist = Categorical(logits, one_hot=True)
    assert not dist.sample((10_000,))[:, 1].any()
    reference = distributions.Categorical(logits=torch.tensor([0.3, 1.0]))
    torch.testing.assert_close(dist.entropy(), reference.entropy())
    (gradient,) = torch.autograd.grad(dist.entropy() + dist.log_prob(dist.sample()), logits)
    assert gradient[[0, 2]].isfinite().all()


def test_samples_have_the_dtype_of_the_spec():
    logits = torch.zeros(4, 3)
    assert Categorical(logits, dtype=torch.int32).sample().dtype == torch.int32
    assert Categorical(logits, one_hot=True, dtype=torch.float32).mode.dtype == torch.float32


def test_expand_keeps_the_distribution():
    dist = Categorical(torch.randn(4, sum(SIZES)), SIZES)
    value = dist.sample()
    expanded = dist.expand((2, 4))
    assert expanded.sample().shape == (2, 4, 3)
    torch.testing.assert_close(expanded.log_prob(value.expand(2, 4, 3))[1], dist.log_prob(value))


def test_sizes_that_do_not_add_up_are_refused():
    with pytest.raises(ValueError, match=r"sizes=\(2, 2\).*5"):
        Categorical(torch.zeros(5), (2, 2))


@pytest.mark.parametrize("options", [{}, {"one_hot": True}, {"sizes": SIZES}], ids=str)
def test_no_host_sync_and_compiles_without_a_break(options):
    logits = torch.randn(6, sum(SIZES))

    def use(logits):
        dist = Categorical(logits, **options)
        sample = dist.sample()
        return dist.entropy(), dist.deterministic_sample, dist.log_prob(sample)

    with count_syncs() as syncs:
        eager = use(logits)
    assert syncs.total == 0, syncs.report()
    compiled = torch.compile(use, fullgraph=True, backend="aot_eager")(logits)
    torch.testing.assert_close(compiled[:2], eager[:2])
