import math

import pytest
import torch
from torch._dynamo.backends.common import aot_autograd
from torch._functorch.aot_autograd import make_boxed_func
from torch.distributions import (
    AffineTransform,
    Independent,
    Normal,
    TanhTransform,
    TransformedDistribution,
    kl_divergence,
)
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import has_analytic_entropy, has_analytic_kl

from ksim_rl.modules import TanhGaussian
from ksim_rl.testing import count_syncs

LOW, HIGH = torch.tensor([-2.0, 0.5, -1.0]), torch.tensor([1.0, 0.7, 1.0])


def _parameters(*shape, dtype=torch.float32):
    return torch.randn(*shape, 3, dtype=dtype), torch.rand(*shape, 3, dtype=dtype) + 0.1


def _grid(low=-1.0, high=1.0, count=400_001):
    """Return points dense near the bounds, where the density can peak, and the weight of each."""
    edges = low + (high - low) * 0.5 * (
        1.0 - torch.cos(torch.linspace(0.0, math.pi, count, dtype=torch.float64))
    )
    return 0.5 * (edges[1:] + edges[:-1]), edges.diff()


@pytest.mark.parametrize(
    "bounds", [(-1.0, 1.0), (LOW.double(), HIGH.double())], ids=["numbers", "tensors"]
)
def test_equals_torch_and_torchrl(bounds):
    low, high = bounds
    loc, scale = (
        parameter.requires_grad_() for parameter in _parameters(6, 4, dtype=torch.float64)
    )
    ours = TanhGaussian(loc, scale, low, high)
    torchrls = TanhNormal(loc, scale, low=low, high=high)
    squash = [TanhTransform(), AffineTransform((low + high) / 2, (high - low) / 2)]
    torchs = Independent(TransformedDistribution(Normal(loc, scale), squash), 1)
    # TorchRL's value near a bound is that at a millionth of the range inside.
    value = low + (high - low) * torch.linspace(1e-4, 1.0 - 1e-4, 72).double().reshape(6, 4, 3)
    gradients = torch.autograd.grad(ours.log_prob(value).sum(), (loc, scale), retain_graph=True)
    for stock in (torchrls, torchs):
        torch.testing.assert_close(
            ours.log_prob(value), stock.log_prob(value), rtol=1e-9, atol=1e-9
        )
        expected = torch.autograd.grad(stock.log_prob(value).sum(), (loc, scale), retain_graph=True)
        torch.testing.assert_close(gradients, expected, rtol=1e-9, atol=1e-9)
        assert ours.batch_shape == stock.batch_shape and ours.event_shape == stock.event_shape
    torch.testing.assert_close(ours.deterministic_sample, torchrls.deterministic_sample)


@pytest.mark.parametrize(("loc", "scale"), [(0.0, 1.0), (0.8, 0.3), (-2.0, 0.5), (0.0, 2.5)])
def test_the_density_integrates_to_one_and_its_entropy_is_that_of_the_estimate(loc, scale):
    low, high = -0.5, 2.0
    dist = TanhGaussian(torch.tensor([loc]).double(), torch.tensor([scale]).double(), low, high)
    points, weights = _grid(low, high)
    log_density = dist.log_prob(points[:, None])
    assert (log_density.exp() * weights).sum().item() == pytest.approx(1.0, abs=1e-5)
    entropy = -(log_density.exp() * log_density * weights).sum()
    estimates = -dist.rsample_and_log_prob((100_000,))[1]
    assert abs(estimates.mean() - entropy) < 4.0 * estimates.std() / math.sqrt(100_000)


def test_std_that_grows_lowers_the_entropy_in_the_end():
    """The entropy bonus of a policy that leaves the correction out makes the standard deviation grow for ever."""
    torch.manual_seed(0)
    gradients = []
    for std in (0.3, 3.0, 10.0):
        scale = torch.full((1,), std, requires_grad=True)
        dist = TanhGaussian(torch.zeros(1), scale)
        entropy = -dist.rsample_and_log_prob((100_000,))[1].mean()
        gradients.append(torch.autograd.grad(entropy, scale)[0].item())
        # No distribution on [-1, 1] has more than the uniform one.
        assert entropy <= math.log(2.0)
    assert gradients[0] > 0.0 > gradients[1] > gradients[2] - 2.0 and gradients[2] < 0.0


def test_log_prob_is_finite_and_right_where_a_plain_correction_underflows():
    loc = torch.tensor([[30.0], [-30.0], [9.5]])
    dist = TanhGaussian(loc, torch.ones(3, 1))
    value, log_prob = dist.rsample_and_log_prob()
    assert value.abs().max() <= 1.0
    assert torch.isfinite(log_prob).all()
    # log(1 - tanh(u)^2) = 2 log 2 - 2 |u| up to e^-2|u|.
    torch.manual_seed(3)
    latent = dist.base.sample()
    torch.manual_seed(3)
    _, log_prob = dist.rsample_and_log_prob()
    expected = dist.base.log_prob(latent) - (2.0 * math.log(2.0) - 2.0 * latent.abs()).sum(-1)
    torch.testing.assert_close(log_prob, expected, rtol=1e-5, atol=1e-5)
    assert torch.isfinite(dist.log_prob(torch.tensor([[1.0], [-1.0], [1.0]]))).all()


def test_samples_have_the_median_and_lie_inside():
    loc, scale = torch.tensor([0.4, -1.0, 2.0]), torch.tensor([0.5, 1.0, 3.0])
    dist = TanhGaussian(loc, scale, LOW, HIGH)
    samples = dist.sample((100_000,))
    assert (samples >= LOW).all() and (samples <= HIGH).all()
    below = (samples < dist.deterministic_sample).double().mean(0)
    assert ((below - 0.5).abs() < 4.0 * 0.5 / math.sqrt(100_000)).all()


def test_both_ways_to_score_a_sample_agree():
    dist = TanhGaussian(*_parameters(5, dtype=torch.float64), LOW.double(), HIGH.double())
    for draw in (dist.rsample_and_log_prob, dist.sample_and_log_prob):
        value, log_prob = draw((7,))
        torch.testing.assert_close(log_prob, dist.log_prob(value))


def test_rounded_parameters_leave_actions_near_a_bound_where_they_are():
    # Bfloat16 has them all.
    loc, scale = (torch.tensor([[4.0, -3.5, 0.0]]), torch.tensor([[0.5, 0.5, 1.0]]))
    value = torch.tanh(torch.tensor([[4.25, -3.75, 0.5]]))
    rounded = TanhGaussian(loc.bfloat16(), scale.bfloat16()).log_prob(value)
    torch.testing.assert_close(
        rounded, TanhGaussian(loc, scale).log_prob(value), rtol=1e-2, atol=1e-2
    )


def test_gradients_are_those_of_finite_differences():
    loc, scale = (parameter.requires_grad_() for parameter in _parameters(4, dtype=torch.float64))
    low, high = LOW.double(), HIGH.double()
    value = TanhGaussian(loc, scale, low, high).sample()

    def sampled(loc, scale):
        torch.manual_seed(1)
        return TanhGaussian(loc, scale, low, high).rsample_and_log_prob()

    assert torch.autograd.gradcheck(
        lambda *parameters: TanhGaussian(*parameters, low, high).log_prob(value), (loc, scale)
    )
    assert torch.autograd.gradcheck(sampled, (loc, scale))


def test_divergence_is_the_mean_log_ratio_of_samples():
    p, q = (TanhGaussian(*_parameters(dtype=torch.float64)) for _ in range(2))
    q = TanhGaussian(p.loc + 0.2, p.scale * 1.2)
    samples = p.sample((100_000,))
    ratios = p.log_prob(samples) - q.log_prob(samples)
    assert abs(ratios.mean() - kl_divergence(p, q)) < 4.0 * ratios.std() / math.sqrt(100_000)
    assert has_analytic_kl(p, q) and not has_analytic_entropy(p)


def test_expand_keeps_the_distribution():
    dist = TanhGaussian(*_parameters(4), LOW, HIGH)
    value = dist.sample()
    expanded = dist.expand((2, 4))
    assert expanded.batch_shape == (2, 4)
    torch.testing.assert_close(expanded.log_prob(value)[1], dist.log_prob(value))


def test_no_host_sync_and_compiles_without_a_break():
    loc, scale = _parameters(6)
    value = torch.rand(6, 3) * 0.1 + 0.55

    def use(loc, scale, value):
        dist = TanhGaussian(loc, scale, LOW, HIGH)
        return dist.log_prob(value), dist.deterministic_sample, *dist.rsample_and_log_prob()

    with count_syncs() as syncs:
        eager = use(loc, scale, value)
    assert syncs.total == 0, syncs.report()
    compiled = torch.compile(use, fullgraph=True, backend="aot_eager")(loc, scale, value)
    torch.testing.assert_close(compiled[:2], eager[:2])


def test_compiled_densities_are_summed_by_a_product_and_equal_with_their_gradients():
    loc, raw = torch.randn(6, 5, requires_grad=True), torch.randn(6, 5, requires_grad=True)

    def work(loc, raw):
        return TanhGaussian(loc, raw.exp(), -2.0, 2.0).rsample_and_log_prob()

    kept = []

    def note(graph, _):
        kept.extend(str(node.target) for node in graph.graph.nodes)
        return make_boxed_func(graph.forward)

    compiled = torch.compile(
        work, backend=aot_autograd(fw_compiler=note), fullgraph=True, dynamic=False
    )
    results = []
    for draw in (compiled, work):
        torch.manual_seed(0)
        out = draw(loc, raw)
        results.append(
            [*out, *torch.autograd.grad(out[0].sum() + out[1].square().sum(), [loc, raw])]
        )
    torch.testing.assert_close(*results)
    assert "aten.mm.default" in kept and not any("aten.sum" in name for name in kept)
