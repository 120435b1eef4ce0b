"""The projection of C51 against the paper's algorithm, written as loops."""

import importlib
import math

import pytest
import torch

from ksim_rl.objectives import TD3Loss, cross_entropy, mean_of, project_distribution
from tests.objectives.test_sac_loss import ACTION, minibatch, networks

SUPPORT = torch.linspace(-2.0, 3.0, 11)


def _slow(probs, reward, discount):
    """Algorithm 1 of Bellemare et al. (2017), one atom of one env state at a time."""
    low, high, count = SUPPORT[0].item(), SUPPORT[-1].item(), len(SUPPORT)
    spacing = (high - low) / (count - 1)
    out = torch.zeros_like(probs)
    for row in range(probs.shape[0]):
        for atom in range(count):
            value = min(max(reward[row].item() + discount[row].item() * SUPPORT[atom].item(), low), high)
            position = (value - low) / spacing
            below, above = math.floor(position), math.ceil(position)
            mass = probs[row, atom].item()
            if below == above:
                out[row, min(below, count - 1)] += mass
            else:
                out[row, below] += mass * (above - position)
                out[row, above] += mass * (position - below)
    return out


# tests/conftest.py turns Triton's interpreter on where there is no CUDA.
@pytest.mark.parametrize("by_kernel", [False, True])
@pytest.mark.parametrize(
    "scale", [1.0, *(pytest.param(scale, marks=pytest.mark.full) for scale in (0.1, 20.0))]
)
def test_projection_is_that_of_the_paper(scale, by_kernel):
    project, device = project_distribution, "cpu"
    if by_kernel:
        pytest.importorskip("triton", reason="Triton is not installed")
        project = importlib.import_module("ksim_rl.objectives.projection_kernel").project_by_kernel
        device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(0)
    probs = torch.rand(200, 11).softmax(-1)
    reward = torch.randn(200, 1) * scale
    discount = torch.where(torch.rand(200, 1) < 0.3, 0.0, torch.rand(200, 1))
    # Rewards that fall on atoms exactly, and on the ends.
    reward[:11, 0], discount[:11] = SUPPORT, 0.0
    projected = project(*(tensor.to(device) for tensor in (probs, reward, discount, SUPPORT))).cpu()
    torch.testing.assert_close(projected, _slow(probs, reward, discount), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(projected.sum(-1), torch.ones(200))
    assert (projected >= 0.0).all()


def test_means_survive_the_projection_where_nothing_is_cut_off():
    torch.manual_seed(0)
    probs = torch.rand(50, 11).softmax(-1)
    reward, discount = torch.rand(50, 1), torch.full((50, 1), 0.3)
    projected = project_distribution(probs, reward, discount, SUPPORT)
    torch.testing.assert_close(
        mean_of(projected, SUPPORT), reward[:, 0] + 0.3 * mean_of(probs, SUPPORT), rtol=1e-4, atol=1e-5
    )


def test_cross_entropy_is_torchs():
    logits, probs = torch.randn(20, 11), torch.rand(20, 11).softmax(-1)
    expected = torch.nn.functional.cross_entropy(logits, probs, reduction="none")
    torch.testing.assert_close(cross_entropy(logits, probs), expected)


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
        next_probs = loss.target_critic_network.module(data["next", "critic"], next_action).softmax(-1)
        discount = 0.9 ** data["steps_to_next_obs"] * ~data["next", "terminated"]
        targets = [_slow(next_probs[:, which], data["next", "reward"], discount) for which in range(2)]
        if value_reduction == "min":
            first = (targets[0] @ SUPPORT < targets[1] @ SUPPORT)[:, None]
            targets = [torch.where(first, *targets)] * 2
        logits = critic.module(data["critic"], data["action"])
        expected = sum(
            torch.nn.functional.cross_entropy(logits[:, which], targets[which]) for which in range(2)
        )
        torch.testing.assert_close(out["loss_qvalue"], expected, rtol=1e-4, atol=1e-5)
        own_action = deterministic(data.copy())["loc"].tanh()
        values = critic.module(data["critic"], own_action).softmax(-1) @ SUPPORT
        value = values.amin(-1) if value_reduction == "min" else values.mean(-1)
        torch.testing.assert_close(out["loss_actor"], -value.mean(), rtol=1e-4, atol=1e-5)
