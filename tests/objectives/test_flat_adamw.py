"""AdamW on one piece of memory, beside torch's on many."""

import copy
import dataclasses

import pytest
import torch
from torch import nn

from ksim_rl.algorithms.gradient_steps import load_optimizer_state, optimizer_state
from ksim_rl.objectives import FlatAdamW, SACCfg

CFG = SACCfg(betas=(0.9, 0.95), weight_decay=0.1, tau=0.2, max_grad_norm=0.5)


def _network():
    return nn.Sequential(nn.Linear(5, 7), nn.Tanh(), nn.LayerNorm(7), nn.Linear(7, 3))


def _descend(network, optimizer, *, seed, bad=False):
    torch.manual_seed(seed)
    optimizer.zero_grad()
    loss = network(torch.randn(16, 5)).square().mean() * (float("nan") if bad else 1.0)
    loss.backward()
    return loss


@pytest.mark.parametrize("max_grad_norm", [None, 0.2])
def test_it_is_the_adamw_of_torch(max_grad_norm):
    cfg = SACCfg(betas=(0.9, 0.95), weight_decay=0.1, tau=0.2, max_grad_norm=max_grad_norm)
    network, target = _network(), _network().requires_grad_(False)
    twin, slow = copy.deepcopy(network), copy.deepcopy(target)
    flat = FlatAdamW(cfg, network.parameters(), learning_rate=1e-2, target=target.parameters())
    reference = torch.optim.AdamW(twin.parameters(), lr=1e-2, betas=cfg.betas, weight_decay=0.1)
    for step in range(20):
        norm, skipped = flat.step(_descend(network, flat, seed=step))
        _descend(twin, reference, seed=step)
        expected = nn.utils.clip_grad_norm_(twin.parameters(), max_grad_norm or float("inf"))
        reference.step()
        torch._foreach_lerp_(
            list(slow.parameters()), [own.detach() for own in twin.parameters()], cfg.tau
        )
        torch.testing.assert_close(norm, expected)
        assert not skipped
    for ours, theirs in ((network, twin), (target, slow)):
        for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
            torch.testing.assert_close(one, other)
    for one, other in zip(flat.state.values(), reference.state.values(), strict=True):
        for name in ("step", "exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(one[name], other[name])


def test_a_step_that_is_not_finite_changes_only_the_target():
    network, target = _network(), _network()
    flat = FlatAdamW(CFG, network.parameters(), learning_rate=1e-2, target=target.parameters())
    flat.step(_descend(network, flat, seed=0))
    kept = copy.deepcopy((network.state_dict(), optimizer_state(flat)))
    aside = [own.clone() for own in target.parameters()]
    norm, skipped = flat.step(_descend(network, flat, seed=1, bad=True))
    assert norm.isnan() and skipped == 1.0
    torch.testing.assert_close(
        (network.state_dict(), optimizer_state(flat)), kept, rtol=0.0, atol=0.0
    )
    for old, new, own in zip(aside, target.parameters(), network.parameters(), strict=True):
        torch.testing.assert_close(new, old.lerp(own, CFG.tau))


def test_a_loaded_state_continues():
    network = _network()
    flat = FlatAdamW(CFG, network.parameters(), learning_rate=1e-2)
    for step in range(3):
        flat.step(_descend(network, flat, seed=step))
    twin = copy.deepcopy(network)
    other = FlatAdamW(CFG, twin.parameters(), learning_rate=1e-2)
    other.param_groups[0]["lr"].fill_(0.5)
    load_optimizer_state(other, optimizer_state(flat), what="optimizer")
    for made, optimizer in ((network, flat), (twin, other)):
        optimizer.step(_descend(made, optimizer, seed=9))
    assert all(
        torch.equal(a, b) for a, b in zip(network.parameters(), twin.parameters(), strict=True)
    )


def test_a_state_of_torchs_own_adamw_continues():
    network, rate = _network(), torch.tensor(1e-2)
    twin = copy.deepcopy(network)
    options = {"betas": CFG.betas, "weight_decay": CFG.weight_decay}
    reference = torch.optim.AdamW(network.parameters(), lr=rate, **options)
    for step in range(3):
        _descend(network, reference, seed=step)
        reference.step()
    flat = FlatAdamW(
        dataclasses.replace(CFG, max_grad_norm=None), twin.parameters(), learning_rate=0.5
    )
    twin.load_state_dict(network.state_dict())
    load_optimizer_state(flat, optimizer_state(reference), what="optimizer")
    _descend(network, reference, seed=3)
    reference.step()
    flat.step(_descend(twin, flat, seed=3))
    for one, other in zip(twin.parameters(), network.parameters(), strict=True):
        torch.testing.assert_close(one, other)


def test_a_parameter_that_does_not_learn_stays():
    network = _network()
    network[0].requires_grad_(False)
    weight = next(network.parameters())
    before = weight.clone()
    flat = FlatAdamW(CFG, network.parameters(), learning_rate=1e-2)
    flat.step(_descend(network, flat, seed=0))
    assert torch.equal(weight, before) and len(flat.state) == 4
