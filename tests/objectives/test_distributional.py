"""The projection of C51 against the paper's algorithm, written as loops."""

import importlib
import itertools
import math

import pytest
import torch

from ksim_rl.objectives import TD3Loss, compare, mean_of, project_distribution
from ksim_rl.objectives.distributional import mean_returns
from tests.objectives.test_sac_loss import ACTION, minibatch, networks

SUPPORT = torch.linspace(-2.0, 3.0, 11)


def _slow(probs, reward, discount):
    """Algorithm 1 of Bellemare et al. (2017), one atom of one env state at a time."""
    low, high, count = SUPPORT[0].item(), SUPPORT[-1].item(), len(SUPPORT)
    spacing = (high - low) / (count - 1)
    out = torch.zeros_like(probs)
    for row in range(probs.shape[0]):
        for atom in range(count):
            value = min(
                max(reward[row].item() + discount[row].item() * SUPPORT[atom].item(), low), high
            )
            position = (value - low) / spacing
            below, above = math.floor(position), math.ceil(position)
            mass = probs[row, atom].item()
            if below == above:
                out[row, min(below, count - 1)] += mass
            else:
                out[row, below] += mass * (above - position)
                out[row, above] += mass * (position - below)
    return out


@pytest.mark.parametrize(
    "scale", [1.0, *(pytest.param(scale, marks=pytest.mark.full) for scale in (0.1, 20.0))]
)
def test_projection_is_that_of_the_paper(scale):
    torch.manual_seed(0)
    probs = torch.rand(200, 11).softmax(-1)
    reward = torch.randn(200, 1) * scale
    discount = torch.where(torch.rand(200, 1) < 0.3, 0.0, torch.rand(200, 1))
    # Rewards that fall on atoms exactly, and on the ends.
    reward[:11, 0], discount[:11] = SUPPORT, 0.0
    projected = project_distribution(probs, reward, discount, SUPPORT)
    torch.testing.assert_close(projected, _slow(probs, reward, discount), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(projected.sum(-1), torch.ones(200))
    assert (projected >= 0.0).all()


@pytest.fixture
def kernel():
    """The kernel as it runs on CUDA, or in the interpreter, which tests/conftest.py turns on where there is none."""
    pytest.importorskip("triton", reason="Triton is not installed")
    apply = importlib.import_module("ksim_rl.objectives.distribution_kernel").Compared.apply
    device = "cuda" if torch.cuda.is_available() else "cpu"

    def run(*given):
        found = apply(*(own.to(device) if isinstance(own, torch.Tensor) else own for own in given))
        return [own.cpu() for own in found]

    return run


def _problem(networks, scale, dtype=torch.float32):
    torch.manual_seed(0)
    logits, following = (3.0 * torch.randn(25, networks, 11, dtype=dtype) for _ in range(2))
    reward = torch.randn(25, 1) * scale
    discount = torch.where(torch.rand(25, 1) < 0.3, 0.0, torch.rand(25, 1)).clamp_max(0.99)
    # Rewards that fall on atoms exactly, and on the ends; a discount near none, and none at all.
    reward[:11, 0], discount[:11], discount[11], discount[12] = SUPPORT, 0.0, 1e-3, 1.0
    return logits.requires_grad_(), following, reward, discount


@pytest.mark.parametrize("reduction", ["min", "mean"])
@pytest.mark.parametrize(("networks", "scale"), [(1, 1.0), (2, 1.0), (3, 0.1), (2, 20.0)])
def test_one_kernel_compares_as_the_paper_does(kernel, networks, scale, reduction):
    logits, following, reward, discount = _problem(networks, scale)
    losses, means = kernel(logits, SUPPORT, following, reward, discount, reduction == "min")
    probs = following.softmax(-1)
    targets = torch.stack(
        [_slow(probs[:, which], reward, discount) for which in range(networks)], 1
    )
    if reduction == "min":
        targets = targets[torch.arange(25), (targets @ SUPPORT).argmin(-1)][:, None].expand_as(
            targets
        )
    expected = -(targets * logits.log_softmax(-1)).sum(-1)
    torch.testing.assert_close(losses, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(means, logits.softmax(-1) @ SUPPORT, rtol=1e-4, atol=1e-5)
    weights = torch.randn(25, networks)
    (found,), (true,) = (
        torch.autograd.grad((own * weights).sum(), logits) for own in (losses, expected)
    )
    torch.testing.assert_close(found, true, rtol=1e-4, atol=1e-5)
    plain = compare(logits, SUPPORT, following, reward, discount, reduction)
    torch.testing.assert_close([losses, means], list(plain), rtol=1e-4, atol=1e-5)
    again = kernel(logits, SUPPORT, following, reward, discount, reduction == "min")
    assert all(map(torch.equal, (losses, means), again))


def test_one_kernel_takes_means_and_logits_of_half_precision(kernel):
    logits, following, reward, discount = _problem(2, 1.0, torch.bfloat16)
    exact = logits.detach().float().requires_grad_()
    for given in ((), (following, reward, discount)):
        found = kernel(logits, SUPPORT, *given, *([False] if given else []))[0]
        if given:
            expected = compare(exact, SUPPORT, following.float(), reward, discount, "mean")[0]
        else:
            expected = mean_returns(exact, SUPPORT)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
        (own,), (true,) = (
            torch.autograd.grad(to.square().sum(), of)
            for to, of in ((found, logits), (expected, exact))
        )
        assert own.dtype == torch.bfloat16
        # Cut off by the interpreter, where CUDA rounds, and then rounded.
        torch.testing.assert_close(own.float(), true, rtol=1.2e-2, atol=1e-5)


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")
def test_one_kernel_hides_nothing_that_is_not_finite(kernel):
    # The discount of row 7 is 0.
    for which, row in itertools.product(range(4), (7, 12)):
        given = [own.detach() for own in _problem(2, 1.0)]
        given[which][row] = math.nan
        losses = kernel(given[0], SUPPORT, *given[1:], False)[0]
        assert losses[row].isnan().all() and losses[13:].isfinite().all()


def test_means_survive_the_projection_where_nothing_is_cut_off():
    torch.manual_seed(0)
    probs = torch.rand(50, 11).softmax(-1)
    reward, discount = torch.rand(50, 1), torch.full((50, 1), 0.3)
    projected = project_distribution(probs, reward, discount, SUPPORT)
    torch.testing.assert_close(
        mean_of(projected, SUPPORT),
        reward[:, 0] + 0.3 * mean_of(probs, SUPPORT),
        rtol=1e-4,
        atol=1e-5,
    )


@pytest.mark.parametrize("value_reduction", ["min", "mean"])
def test_distributional_td3_loss_is_its_definition(value_reduction):
    actor, critic = networks(num_atoms=11, v_min=-2.0, v_max=3.0)
    deterministic = actor[0]

    class _Actor(torch.nn.Module):
        in_keys, out_keys = ["actor"], ["action"]

        def forward(self, td):
            return td.set("action", deterministic(td.copy())["loc"].tanh())

    bound = torch.ones(ACTION)
    loss = TD3Loss(
        _Actor(),
        critic,
        low_L=-bound,
        high_L=bound,
        target_noise=0.0,
        support_A=critic.module.support,
        gamma=0.9,
        value_reduction=value_reduction,
    )
    with torch.no_grad():
        for parameter in loss.target_critic_network.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    data = minibatch()
    out = loss(data)
    with torch.no_grad():
        next_action = deterministic(data["next"].copy())["loc"].tanh()
        next_probs = loss.target_critic_network.module(data["next", "critic"], next_action).softmax(
            -1
        )
        discount = 0.9 ** data["steps_to_next_obs"] * ~data["next", "terminated"]
        targets = [
            _slow(next_probs[:, which], data["next", "reward"], discount) for which in range(2)
        ]
        if value_reduction == "min":
            first = (targets[0] @ SUPPORT < targets[1] @ SUPPORT)[:, None]
            targets = [torch.where(first, *targets)] * 2
        logits = critic.module(data["critic"], data["action"])
        expected = sum(
            torch.nn.functional.cross_entropy(logits[:, which], targets[which])
            for which in range(2)
        )
        torch.testing.assert_close(out["loss_qvalue"], expected, rtol=1e-4, atol=1e-5)
        own_action = deterministic(data.copy())["loc"].tanh()
        values = critic.module(data["critic"], own_action).softmax(-1) @ SUPPORT
        value = values.amin(-1) if value_reduction == "min" else values.mean(-1)
        torch.testing.assert_close(out["loss_actor"], -value.mean(), rtol=1e-4, atol=1e-5)
