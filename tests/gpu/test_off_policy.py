"""Off-policy updates as CUDA graphs. Skipped where there is no GPU."""

import copy
import dataclasses
from contextlib import nullcontext
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Unbounded

from ksim_rl.data import OfflineCfg
from ksim_rl.device import state_tree
from ksim_rl.modules.mlp import mlp
from ksim_rl.objectives import FlatAdamW, SACCfg, TD3Cfg, compare, frozen
from ksim_rl.objectives.distributional import mean_returns
from tests.algorithms.off_policy_problem import make_update, recorded_table
from tests.gpu.no_syncs import no_syncs

pytestmark = pytest.mark.gpu
NUM_ENVS, LENGTH = 64, 4
OBJECTIVES = {
    "sac": SACCfg(alpha_init=0.1),
    "fast_sac": SACCfg(value_reduction="mean", policy_delay=4, weight_decay=1e-3),
    "fast_td3": TD3Cfg(weight_decay=0.1),
    "fast_sac_compiled": SACCfg(
        value_reduction="mean", policy_delay=2, weight_decay=1e-3, compile=True, autocast=True
    ),
}


class _Env:
    """What an update asks of an env."""

    batch_size = torch.Size([NUM_ENVS])
    action_spec = Unbounded((NUM_ENVS, 1))


def _update(name, **options):
    torch.manual_seed(0)
    cfg = OBJECTIVES[name]
    update = make_update(name, _Env(), objective=cfg, device="cuda", learning_starts=1, **options)
    if options.get("offline"):
        update.learn_also_from(recorded_table(n_step=update.data.n_step, device="cuda"))
    return update


def _rollout():
    shape = (NUM_ENVS, LENGTH)
    obs = torch.randn(NUM_ENVS, LENGTH + 1, 1, device="cuda")
    done = torch.rand(*shape, 1, device="cuda") < 0.2
    leaves = {
        "actor": obs[:, :-1],
        "critic": obs[:, :-1],
        "action": torch.rand(*shape, 1, device="cuda"),
        ("next", "actor"): obs[:, 1:],
        ("next", "critic"): obs[:, 1:],
        ("next", "reward"): torch.randn(*shape, 1, device="cuda"),
        ("next", "done"): done,
        ("next", "terminated"): done & (torch.rand(*shape, 1, device="cuda") < 0.5),
    }
    return TensorDict(leaves, shape, device="cuda").clone()


@pytest.mark.parametrize("name", list(OBJECTIVES))
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"prioritized": True, "n_step": 3},
        {"offline": OfflineCfg(source="made_up"), "n_step": 3},
    ],
)
def test_captured_without_syncs_and_learning_what_it_sees(name, options):
    update, rollout = _update(name, **options), _rollout()
    cut = 0
    for iteration in range(6):
        if iteration:
            # Each of these rollouts begins elsewhere than the last one ended, which takes its last env state away.
            cut += int((~rollout["next", "done"][:, -1]).sum())
        # New numbers at the same addresses, as a rollout collector gives them; one is not finite.
        rollout.copy_(_rollout())
        rollout["next", "reward"][iteration, 2] = float("nan")
        before = [parameter.detach().clone() for parameter in update.loss.parameters()]
        with no_syncs(on=iteration > 3):
            update(rollout)
        assert not all(
            torch.equal(a, b) for a, b in zip(before, update.loss.parameters(), strict=True)
        )
    assert update._run.ready
    metrics = update.metrics()
    assert (
        int(metrics["update/non_finite_env_states"]) == 6
        and int(metrics["update/skipped_steps"]) == 0
    )
    # Each replay wrote to the ring where the last one ended.
    assert int(metrics["replay/env_states"]) == 6 * (NUM_ENVS * LENGTH - 1) - cut
    newest = update.replay.storage.index(
        torch.arange(NUM_ENVS, device="cuda"),
        torch.zeros(NUM_ENVS, dtype=torch.int64, device="cuda"),
    )
    going = ~rollout["next", "done"][:, -1, 0]
    stored = update.replay.storage.content["actor"][newest]
    assert torch.equal(stored[going], rollout["next", "actor"][going, -1])


def test_captured_updates_equal_eager_ones():
    captured, eager, rollout = _update("fast_td3"), _update("fast_td3"), _rollout()
    for _ in range(5):
        rollout.copy_(_rollout())
        results = []
        for update in (captured, eager):
            # Both draw the same numbers; a graph reads the generator's state when it is replayed.
            torch.cuda.manual_seed(7)
            if update is captured:
                update(rollout)
            else:
                update._rollout_ET = rollout
                update._update()
            results.append(update.metrics())
        torch.testing.assert_close(
            results[0]["loss/value"], results[1]["loss/value"], rtol=1e-3, atol=1e-4
        )
    for one, other in zip(captured.loss.parameters(), eager.loss.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_equal_updates_that_are_compiled_anew_have_equal_bits():
    states = []
    for _ in range(3):
        torch.compiler.reset()
        # As large as a kernel of many sums needs to be timed by the compiler, if it may.
        update, rollout = (
            _update("fast_sac_compiled", num_env_states_per_minibatch=32768),
            _rollout(),
        )
        for _ in range(5):
            rollout.copy_(_rollout())
            update(rollout)
        states.append(state_tree.split(update.state_dict())[0])
    for other in states[1:]:
        assert [
            name for name, leaf in other.items() if not torch.equal(leaf, states[0][name])
        ] == []


def test_bfloat16_learns_like_float32():
    losses = {}
    for autocast in (False, True):
        torch.manual_seed(0)
        cfg = dataclasses.replace(OBJECTIVES["fast_sac"], autocast=autocast)
        update = make_update("fast_sac", _Env(), objective=cfg, device="cuda", learning_starts=1)
        rollout = _rollout()
        for _ in range(20):
            update(rollout)
        metrics = update.metrics()
        assert int(metrics["update/skipped_steps"]) == 0
        assert all(parameter.dtype == torch.float32 for parameter in update.loss.parameters())
        losses[autocast] = metrics["loss/value"].item()
    assert losses[True] == pytest.approx(losses[False], rel=0.1)


def test_compiled_losses_are_those_of_eager_ones():
    objective = TD3Cfg(target_noise=0.0, compile=True)
    torch.manual_seed(0)
    update = make_update("fast_td3", _Env(), objective=objective, device="cuda", learning_starts=1)
    update(_rollout())
    minibatch_B = next(update.replay.minibatches(1))
    for compiled, eager in (
        (update._critic_loss, update.loss.critic_loss),
        (update._actor_losses, update.loss.actor_losses),
    ):
        with frozen(update.critic) if eager == update.loss.actor_losses else nullcontext():
            found, expected = compiled(minibatch_B)[0], eager(minibatch_B)[0]
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("reduction", "atoms"), [("min", 101), ("mean", 101), ("mean", 51)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_distributions_are_compared_as_on_the_cpu_with_the_same_bits_each_time(
    dtype, reduction, atoms, compiled
):
    torch.manual_seed(0)
    support = torch.linspace(-2.0, 6.0, atoms)
    logits, following = (3.0 * torch.randn(513, 2, atoms).to(dtype) for _ in range(2))
    reward, discount = torch.randn(513, 1) * 3, torch.where(torch.rand(513, 1) < 0.1, 0.0, 0.97)
    given = support, following, reward, discount
    forward: Any = partial(compare, reduction=reduction)
    fast = torch.compile(forward, fullgraph=True, dynamic=False) if compiled else forward

    def run(work, logits, *given):
        logits = logits.detach().requires_grad_()
        losses, means = work(logits, *given)
        values = mean_returns(logits, given[0])
        return losses, means, values, *torch.autograd.grad((losses.square() + values).sum(), logits)

    moved = [own.cuda() for own in (logits, *given)]
    found, expected = (
        run(fast, *moved),
        run(forward, logits.float(), support, following.float(), reward, discount),
    )
    for one, other in zip(found, expected, strict=True):
        # bfloat16 rounds gradients twice, and their sum.
        tolerance = 0.01 if one.dtype == torch.bfloat16 else 1e-5
        assert (one.float().cpu() - other).norm() < tolerance * other.norm()
    assert all(map(torch.equal, found, run(fast, *moved)))


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(
    ("num_networks", "hidden_dims"),
    [(None, (512, 256, 128)), (2, (768, 384, 192)), (2, (512, 256, 128)), (3, (100, 36))],
)
def test_layers_in_half_precision_err_as_torch_does(num_networks, hidden_dims, compiled):
    torch.manual_seed(0)
    options = {
        "activation": "silu",
        "layer_norm": True,
        "num_networks": num_networks,
        "device": "cuda",
    }
    layers = mlp(315, hidden_dims, 101, **options)
    for parameter in layers.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    shape = (2048, 315) if num_networks is None else (num_networks, 2048, 315)
    inputs = torch.randn(shape, device="cuda").requires_grad_()

    def run(forward, *, autocast=True):
        with torch.autocast("cuda", torch.bfloat16, enabled=autocast):
            out = forward(inputs)
        loss = out.float().log_softmax(-1)[..., 7].square().mean()
        return out.detach(), *torch.autograd.grad(loss, [inputs, *layers.parameters()])

    def as_torch(inputs):
        return nn.Sequential.forward(layers, inputs)

    exact, of_torch = run(layers, autocast=False), run(as_torch)
    forward = torch.compile(layers, fullgraph=True, dynamic=False) if compiled else layers
    ours = run(forward)
    assert ours[0].dtype == torch.bfloat16
    for one, plain, true in zip(ours, of_torch, exact, strict=True):
        assert one.shape == true.shape
        allowed = max(0.01, 1.3 * float((plain - true).norm() / true.norm()))
        assert (one - true).norm() < allowed * true.norm()
    assert all(map(torch.equal, ours, run(forward)))


def test_a_compiled_step_of_flat_memory_is_the_adamw_of_torch():
    torch.manual_seed(0)
    network = mlp(315, (768, 384), 101, num_networks=2, layer_norm=True, device="cuda")
    twin, target = copy.deepcopy(network), copy.deepcopy(network).requires_grad_(False)
    cfg = SACCfg(betas=(0.9, 0.95), weight_decay=0.1, tau=0.2, max_grad_norm=0.5, compile=True)
    flat = FlatAdamW(cfg, network.parameters(), learning_rate=1e-3, target=target.parameters())
    reference = torch.optim.AdamW(
        twin.parameters(), lr=1e-3, betas=cfg.betas, weight_decay=0.1, fused=True
    )
    for _ in range(5):
        for one, other in zip(network.parameters(), twin.parameters(), strict=True):
            one.grad = torch.randn_like(one)
            other.grad = one.grad.clone()
        norm, skipped = flat.step(torch.zeros((), device="cuda"))
        torch.testing.assert_close(norm, nn.utils.clip_grad_norm_(twin.parameters(), 0.5))
        reference.step()
        assert not skipped
    for one, other in zip(network.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
    before = [own.clone() for own in network.parameters()]
    gradient = next(network.parameters()).grad
    assert gradient is not None
    gradient.fill_(float("nan"))
    assert flat.step(torch.zeros((), device="cuda"))[1] == 1.0
    assert all(map(torch.equal, before, network.parameters()))
