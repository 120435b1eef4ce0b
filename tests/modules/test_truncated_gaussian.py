import math

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.modules import TruncatedNormal
from torchrl.modules.distributions.utils import has_analytic_entropy, has_analytic_kl

from ksim_rl.modules import TruncatedGaussian
from ksim_rl.testing import count_syncs

LOW, HIGH = torch.tensor([-2.0, 0.5, -1.0]), torch.tensor([1.0, 0.7, 1.0])
# (loc, scale) on [-1, 1]: inside, on a bound, wide, narrow, and further out than Phi can tell from 0 or 1.
CASES = [
    (0.2, 0.5),
    (1.0, 0.3),
    (0.0, 50.0),
    (0.9, 1e-3),
    (3.0, 0.2),
    (-9.0, 0.2),
    (20.0, 0.5),
    (-41.0, 1.0),
]


def _parameters(*shape, dtype=torch.float32):
    return torch.randn(*shape, 3, dtype=dtype), torch.rand(*shape, 3, dtype=dtype) + 0.1


def _single(loc, scale, dtype=torch.float64):
    return TruncatedGaussian(torch.tensor([loc], dtype=dtype), torch.tensor([scale], dtype=dtype))


def _grid():
    """Return points of [-1, 1], dense where a density of `CASES` can peak, and the weight of each."""
    tails = torch.logspace(-12, 0, 40_000, dtype=torch.float64)
    inner = torch.linspace(0.88, 0.92, 40_000, dtype=torch.float64)
    edges = torch.cat(
        [-1.0 + tails, 1.0 - tails, inner, torch.tensor([-1.0, 1.0]).double()]
    ).unique()
    return 0.5 * (edges[1:] + edges[:-1]), edges.diff()


def test_equals_torchrl():
    # Near the bounds: TorchRL's own distribution function cancels further out.
    loc, scale = LOW + (HIGH - LOW) * torch.rand(6, 4, 3), torch.rand(6, 4, 3) + 0.1
    ours = TruncatedGaussian(loc, scale, LOW, HIGH)
    stock = TruncatedNormal(loc, scale, low=LOW, high=HIGH, tanh_loc=False)
    value = ours.sample()
    torch.testing.assert_close(ours.log_prob(value), stock.log_prob(value), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(ours.mode, stock.mode)


def test_log_prob_and_its_gradients_equal_torchs_also_on_the_bounds():
    low, high = LOW.double(), HIGH.double()
    loc = (low + (high - low) * torch.rand(6, 3).double()).requires_grad_()
    scale = (torch.rand(6, 3).double() + 0.1).requires_grad_()
    gaussian = Normal(loc, scale)
    for value in (low, 0.3 * low + 0.7 * high, high):
        expected = gaussian.log_prob(value) - (gaussian.cdf(high) - gaussian.cdf(low)).log()
        log_prob = TruncatedGaussian(loc, scale, low, high).log_prob(value)
        torch.testing.assert_close(log_prob, expected.sum(-1), rtol=1e-9, atol=1e-9)
        gradients = [
            torch.autograd.grad(total.sum(), (loc, scale), retain_graph=True)
            for total in (log_prob, expected)
        ]
        torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("loc", "scale"), CASES)
def test_density_entropy_and_moments_equal_numerical_integrals(loc, scale):
    dist = _single(loc, scale)
    points, weights = _grid()
    log_density = dist.log_prob(points[:, None])
    density = log_density.exp() * weights
    assert density.sum().item() == pytest.approx(1.0, abs=1e-5)
    mean = (density * points).sum()
    assert dist.mean.item() == pytest.approx(mean.item(), abs=1e-5)
    variance = (density * (points - mean).square()).sum()
    assert dist.variance.item() == pytest.approx(variance.item(), rel=2e-3, abs=1e-9)
    assert dist.entropy().item() == pytest.approx(-(density * log_density).sum().item(), abs=1e-4)


@pytest.mark.parametrize(("loc", "scale"), CASES)
def test_float32_equals_float64_in_the_tails(loc, scale):
    single, double = _single(loc, scale, torch.float32), _single(loc, scale)
    value = torch.linspace(-1.0, 1.0, 9)[:, None]
    torch.testing.assert_close(
        single.log_prob(value).double(), double.log_prob(value.double()), rtol=2e-5, atol=3e-2
    )
    torch.testing.assert_close(single.entropy().double(), double.entropy(), rtol=1e-3, atol=3e-2)


@pytest.mark.parametrize(("loc", "scale"), CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_have_the_moments_and_lie_inside(loc, scale, dtype):
    torch.manual_seed(0)
    dist, count = _single(loc, scale, dtype), 100_000
    samples = dist.sample((count,)).double()
    assert samples.abs().max() <= 1.0
    exact = _single(loc, scale)
    error = (samples.mean() - exact.mean).abs() / (exact.variance / count).sqrt()
    assert error.item() < 4.0
    # Of a distribution near a uniform or exponential one the variance's own error is below 3 variances / sqrt(count).
    assert samples.var().item() == pytest.approx(
        exact.variance.item(), rel=4.0 * 3.0 / math.sqrt(count)
    )


def test_without_near_bounds_it_is_the_gaussian():
    loc, scale = _parameters(5)
    ours, gaussian = TruncatedGaussian(loc, scale, -50.0, 50.0), Independent(Normal(loc, scale), 1)
    value = gaussian.sample()
    torch.testing.assert_close(ours.log_prob(value), gaussian.log_prob(value))
    torch.testing.assert_close(ours.entropy(), gaussian.entropy())
    torch.testing.assert_close(ours.mean, gaussian.mean)


def test_wide_it_is_the_uniform_distribution():
    dist = _single(0.3, 1e3, torch.float32)
    assert dist.entropy().item() == pytest.approx(math.log(2.0), abs=1e-3)
    assert dist.log_prob(torch.tensor([0.9])).item() == pytest.approx(-math.log(2.0), abs=1e-3)


def test_nothing_is_outside():
    assert _single(0.0, 1.0).log_prob(torch.tensor([1.01]).double()).item() == -math.inf


def test_gradients_are_those_of_finite_differences():
    torch.manual_seed(2)
    loc, scale = (parameter.requires_grad_() for parameter in _parameters(4, dtype=torch.float64))
    low, high = LOW.double(), HIGH.double()
    value = TruncatedGaussian(loc, scale, low, high).sample()

    def sampled(loc, scale):
        torch.manual_seed(1)
        return TruncatedGaussian(loc, scale, low, high).rsample()

    def scored(loc, scale):
        dist = TruncatedGaussian(loc, scale, low, high)
        other = TruncatedGaussian(loc * 0.5, scale * 1.5, low, high)
        return dist.log_prob(value), dist.entropy(), dist.mean, kl_divergence(dist, other)

    for function in (sampled, scored):
        assert torch.autograd.gradcheck(function, (loc, scale))


@pytest.mark.parametrize(("loc", "scale"), CASES)
def test_gradients_are_finite_in_the_tails(loc, scale):
    parameters = torch.tensor([loc], requires_grad=True), torch.tensor([scale], requires_grad=True)
    dist = TruncatedGaussian(*parameters)
    total = (
        dist.rsample((1000,)).sum()
        + dist.log_prob(dist.sample((1000,))).sum()
        + dist.entropy().sum()
    )
    assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(total, parameters))


@pytest.mark.parametrize(("loc", "scale"), [(0.2, 0.5), (3.0, 0.2), (-9.0, 0.4)])
def test_divergence_equals_the_numerical_integral(loc, scale):
    p, q = _single(loc, scale), _single(loc + 0.3, scale * 1.3)
    points, weights = _grid()
    log_p, log_q = p.log_prob(points[:, None]), q.log_prob(points[:, None])
    expected = (log_p.exp() * (log_p - log_q) * weights).sum().item()
    assert kl_divergence(p, q).item() == pytest.approx(expected, abs=1e-5)
    assert kl_divergence(p, p).item() == pytest.approx(0.0, abs=1e-12)
    assert has_analytic_entropy(p) and has_analytic_kl(p, q)


def test_expand_keeps_the_distribution():
    dist = TruncatedGaussian(*_parameters(4), LOW, HIGH)
    value = dist.sample()
    torch.testing.assert_close(dist.expand((2, 4)).log_prob(value)[1], dist.log_prob(value))


def test_no_host_sync_and_compiles_without_a_break():
    loc, scale = _parameters(6)
    value = torch.rand(6, 3) * 0.1 + 0.55

    def use(loc, scale, value):
        dist = TruncatedGaussian(loc, scale, LOW, HIGH)
        return dist.log_prob(value), dist.entropy(), dist.deterministic_sample, dist.rsample()

    with count_syncs() as syncs:
        eager = use(loc, scale, value)
    assert syncs.total == 0, syncs.report()
    compiled = torch.compile(use, fullgraph=True, backend="aot_eager")(loc, scale, value)
    torch.testing.assert_close(compiled[:3], eager[:3])
