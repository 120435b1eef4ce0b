import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.modules.distributions.utils import has_analytic_entropy, has_analytic_kl

from ksim_rl.modules import DiagonalGaussian
from ksim_rl.testing import count_syncs


@pytest.fixture
def pair():
    loc, scale = torch.randn(6, 4, 3), torch.rand(6, 4, 3) + 0.1
    return DiagonalGaussian(loc, scale), Independent(Normal(loc, scale), 1)


def test_equals_independent_normal(pair):
    ours, reference = pair
    value = torch.randn(6, 4, 3)
    torch.testing.assert_close(ours.log_prob(value), reference.log_prob(value))
    torch.testing.assert_close(ours.entropy(), reference.entropy())
    assert ours.batch_shape == reference.batch_shape
    assert ours.event_shape == reference.event_shape
    for name in ("mean", "mode", "stddev", "variance"):
        torch.testing.assert_close(getattr(ours, name), getattr(reference, name))
    assert torch.equal(ours.deterministic_sample, reference.mean)


def test_gradients_equal_those_of_independent_normal():
    loc, value = torch.randn(5, 3, requires_grad=True), torch.randn(5, 3)
    scale = (torch.rand(5, 3) + 0.1).requires_grad_()
    gradients = []
    for dist in (DiagonalGaussian(loc, scale), Independent(Normal(loc, scale), 1)):
        gradients.append(
            torch.autograd.grad((dist.log_prob(value) + dist.entropy()).sum(), (loc, scale))
        )
    for ours, reference in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, reference)


def test_divergence_equals_that_of_independent_normals(pair):
    _, p = pair
    q = Independent(Normal(torch.randn(6, 4, 3), torch.rand(6, 4, 3) + 0.1), 1)
    ours = [DiagonalGaussian(dist.base_dist.loc, dist.base_dist.scale) for dist in (p, q)]
    torch.testing.assert_close(kl_divergence(*ours), kl_divergence(p, q))


def test_samples_have_the_moments():
    loc, scale = torch.tensor([1.0, -2.0]), torch.tensor([0.5, 3.0])
    samples = DiagonalGaussian(loc, scale).sample((200_000,))
    torch.testing.assert_close(samples.mean(0), loc, atol=0.03, rtol=0.0)
    torch.testing.assert_close(samples.std(0), scale, atol=0.03, rtol=0.0)


def test_samples_come_from_the_default_generator():
    dist = DiagonalGaussian(torch.zeros(3), torch.ones(3))
    torch.manual_seed(5)
    first = dist.sample()
    torch.manual_seed(5)
    assert torch.equal(first, dist.sample())


def test_rsample_carries_gradients_and_sample_does_not():
    loc = torch.zeros(3, requires_grad=True)
    dist = DiagonalGaussian(loc, torch.ones(3))
    assert dist.rsample().requires_grad
    assert not dist.sample().requires_grad


def test_expand_keeps_the_distribution(pair):
    ours, _ = pair
    expanded = ours.expand((2, 6, 4))
    assert expanded.batch_shape == (2, 6, 4)
    value = torch.randn(6, 4, 3)
    torch.testing.assert_close(expanded.log_prob(value)[1], ours.log_prob(value))


def test_torchrl_knows_its_closed_forms(pair):
    ours, _ = pair
    assert has_analytic_entropy(ours)
    assert has_analytic_kl(ours, ours)


def test_no_host_sync():
    loc, scale, value = torch.randn(6, 3), torch.rand(6, 3), torch.randn(6, 3)
    with count_syncs() as syncs:
        dist = DiagonalGaussian(loc, scale)
        dist.sample()
        dist.log_prob(value)
        dist.entropy()
    assert syncs.total == 0, syncs.report()
