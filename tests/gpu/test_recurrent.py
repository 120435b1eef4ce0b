"""Memories on a GPU: the fused kernels against torch; rollout and update as one graph each."""

import pytest
import torch
from torch import nn

from ksim_rl import conf
from ksim_rl.device import state_tree
from ksim_rl.modules import RecurrentCfg, RecurrentNetwork
from ksim_rl.modules.recurrent import STATES
from ksim_rl.trainers import build
from tests.gpu.no_syncs import no_syncs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]
T, B, OBS, H = 24, 64, 48, 256
kinds = pytest.mark.parametrize("kind", ["lstm", "gru"])


@kinds
@pytest.mark.parametrize("num_layers", [1, 2])
def test_fused_kernels_give_the_outputs_and_gradients_of_the_cpu(kind, num_layers):
    torch.manual_seed(0)
    cfg = RecurrentCfg(kind=kind, hidden_dim=H, num_layers=num_layers)
    on_cpu = RecurrentNetwork(cfg, obs_dim=OBS).double()
    on_gpu = RecurrentNetwork(cfg, obs_dim=OBS, device="cuda").double()
    on_gpu.load_state_dict(on_cpu.state_dict())
    obs_TB = torch.randn(T, B, OBS, dtype=torch.float64)
    state_BN = tuple(torch.randn(B, num_layers, H, dtype=torch.float64) for _ in STATES[kind])
    reset_TB1 = torch.rand(T, B, 1) < 0.1
    results = []
    for network, device in ((on_cpu, "cpu"), (on_gpu, "cuda")):
        leaves = [leaf.to(device, copy=True).requires_grad_() for leaf in (obs_TB, *state_BN)]
        features_TB, states_TB = network(leaves[0], tuple(leaves[1:]), reset_TB1.to(device))
        loss = (features_TB.square()).sum() + sum(part[-1].sin().sum() for part in states_TB)
        gradients = torch.autograd.grad(loss, [*leaves, *network.parameters()])
        results.append([features_TB, *states_TB, *gradients])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other.cpu(), atol=1e-9, rtol=1e-9)


@kinds
def test_without_resets_they_equal_cudnn(kind):
    torch.manual_seed(0)
    cudnn = {"lstm": nn.LSTM, "gru": nn.GRU}[kind](OBS, H).cuda()
    network = RecurrentNetwork(RecurrentCfg(kind=kind, hidden_dim=H), obs_dim=OBS, device="cuda")
    network.load_state_dict(cudnn.state_dict())
    obs_TB = torch.randn(T, B, OBS, device="cuda")
    state_BN = tuple(torch.zeros(B, 1, H, device="cuda") for _ in STATES[kind])
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False
    torch.testing.assert_close(network(obs_TB, state_BN)[0], cudnn(obs_TB)[0], atol=1e-5, rtol=1e-5)


@kinds
@pytest.mark.parametrize(
    "sequences", [[], ["data.sequence_length=4", "data.burn_in=2"]], ids=["whole", "burn_in"]
)
def test_rollout_and_update_are_one_graph_each_and_equal_the_eager_ones(kind, sequences):
    overrides = [
        "task=cartpole_balance",
        f"modules={kind}",
        "device=cuda",
        "logger=none",
        "num_envs=16",
        "data.num_env_states_per_minibatch=64",
        "data.num_minibatches=2",
        "task.episode_length_s=0.1",
        "trainer.eval_episodes=0",
        *sequences,
    ]
    trainer = build(conf.compose(overrides))
    update, collector = trainer.update, trainer.collector
    for _ in range(5):
        update(collector.collect())
    assert collector._run.ready and update._run.ready
    with no_syncs():
        rollout_ET = collector.collect()
    assert rollout_ET["is_init"].any() and not rollout_ET["is_init"].all()
    state = state_tree.join(*state_tree.split(update.state_dict()))
    with no_syncs():
        update(rollout_ET)
    captured = {name: leaf.clone() for name, leaf in networks(update).items()}
    update.load_state_dict(state)
    before = {name: leaf.clone() for name, leaf in networks(update).items()}
    update._update()
    for name, leaf in networks(update).items():
        torch.testing.assert_close(
            captured[name], leaf, atol=1e-5, rtol=1e-4, msg=lambda m, n=name: f"{n}: {m}"
        )
    assert any(not torch.equal(before[name], leaf) for name, leaf in captured.items())


def networks(update):
    """Return all that an update learns, and the states that it carries."""
    return {
        **{f"actor.{name}": leaf for name, leaf in update.actor.state_dict().items()},
        **{f"critic.{name}": leaf for name, leaf in update.critic.state_dict().items()},
        **update._carried.state_dict(),
    }
