"""The discriminator scores pairs of states, both normalized by the same statistics."""

import torch

from ksim_rl.modules import Discriminator
from ksim_rl.objectives import discriminator_loss
from ksim_rl.testing import count_syncs

L = 3


def test_a_discriminator_normalizes_both_states_alike_and_learns_without_host_syncs():
    net = Discriminator(L, hidden_dims=(8,))
    states_NL = 5.0 + 2.0 * torch.randn(1000, L)
    net.normalizer.update(states_NL)
    transition_N2L = torch.stack((states_NL, states_NL.flip(0)), 1)
    mean, var = states_NL.mean(0), states_NL.var(0, correction=0)
    by_hand = torch.cat(
        [(part - mean) / (var + 1e-4).sqrt() for part in transition_N2L.unbind(1)], -1
    )
    torch.testing.assert_close(net.normalized(transition_N2L), by_hand, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(
        net(transition_N2L), net.layers(by_hand).squeeze(-1), atol=1e-4, rtol=1e-4
    )
    with count_syncs() as syncs:
        normalized = net.normalized(transition_N2L)
        loss, _ = discriminator_loss(net.judge, normalized, -normalized, gradient_penalty=10.0)
        loss.backward()
    assert syncs.total == 0, syncs.report()
    assert all(parameter.grad is not None for parameter in net.parameters())
