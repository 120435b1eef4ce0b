"""The loss of the discriminator against its closed form, and the style reward against its definition."""

import pytest
import torch
from torch import nn

from ksim_rl.objectives import discriminator_loss, style_reward

L = 3


def test_of_a_linear_discriminator_loss_and_gradient_have_a_closed_form():
    torch.manual_seed(0)
    reference, policy = (
        torch.randn(40, L, dtype=torch.float64),
        torch.randn(25, L, dtype=torch.float64),
    )
    weight = torch.randn(L, dtype=torch.float64, requires_grad=True)
    bias = torch.randn((), dtype=torch.float64, requires_grad=True)
    loss, logged = discriminator_loss(
        lambda x: x @ weight + bias, reference, policy, gradient_penalty=7.0
    )
    loss.backward()
    with torch.no_grad():
        d_reference, d_policy = reference @ weight + bias, policy @ weight + bias
        penalty = weight.square().sum()
        expected = (
            (d_reference - 1).square().mean() + (d_policy + 1).square().mean() + 3.5 * penalty
        )
        slope = (
            2 * ((d_reference - 1) @ reference) / 40
            + 2 * ((d_policy + 1) @ policy) / 25
            + 7.0 * weight
        )
    torch.testing.assert_close(loss.detach(), expected)
    torch.testing.assert_close(weight.grad, slope)
    torch.testing.assert_close(bias.grad, 2 * (d_reference - 1).mean() + 2 * (d_policy + 1).mean())
    torch.testing.assert_close(logged["penalty"], penalty)
    torch.testing.assert_close(logged["reference_score"], d_reference.mean())


def test_the_penalty_of_a_network_equals_the_written_out_slope_at_each_transition():
    torch.manual_seed(1)
    hidden, out = nn.Linear(L, 16).double(), nn.Linear(16, 1).double()
    reference, policy = torch.randn(12, L).double(), torch.randn(12, L).double()

    def judge(x):
        return out(torch.tanh(hidden(x))).squeeze(-1)

    parameters = [*hidden.parameters(), *out.parameters()]
    loss, _ = discriminator_loss(judge, reference, policy, gradient_penalty=10.0)
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    # One transition at a time: dD/dx of a tanh layer, written out, so that one backward pass is enough.
    slow = torch.zeros((), dtype=torch.float64)
    for row in reference:
        unit = torch.tanh(hidden.weight @ row + hidden.bias)
        slope = hidden.weight.T @ (out.weight[0] * (1 - unit**2))
        slow = slow + ((out.weight[0] @ unit + out.bias[0] - 1) ** 2 + 5.0 * slope @ slope) / 12
    for row in policy:
        slow = (
            slow
            + (out.weight[0] @ torch.tanh(hidden.weight @ row + hidden.bias) + out.bias[0] + 1) ** 2
            / 12
        )
    torch.testing.assert_close(loss, slow)
    for one, other in zip(gradients, torch.autograd.grad(slow, parameters), strict=True):
        torch.testing.assert_close(one, other)


def test_masked_pairs_do_not_count():
    reference, policy = torch.randn(8, L), torch.randn(8, L)
    weight = torch.randn(L)
    mask = torch.tensor([True] * 5 + [False] * 3)
    policy[5:] = float("inf")
    loss, logged = discriminator_loss(
        lambda x: x @ weight, reference, policy, gradient_penalty=1.0, mask_B=mask
    )
    kept, _ = discriminator_loss(
        lambda x: x @ weight, reference[:5], policy[:5], gradient_penalty=1.0
    )
    torch.testing.assert_close(loss, kept)
    assert logged["policy_score"].isfinite()


@pytest.mark.parametrize(
    ("score", "reward"),
    [(1.0, 1.0), (-1.0, 0.0), (3.0, 0.0), (0.0, 0.75), (-5.0, 0.0), (2.0, 0.75)],
)
def test_the_style_reward_is_one_for_motions_and_zero_for_the_policy(score, reward):
    assert style_reward(torch.tensor(score)).item() == pytest.approx(reward)
