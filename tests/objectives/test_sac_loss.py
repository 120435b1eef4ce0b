"""SAC's losses against TorchRL's own, with the same networks, numbers and draws."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch._dynamo.backends.common import aot_autograd
from torch._functorch.aot_autograd import make_boxed_func
from torch._inductor.decomposition import select_decomp_table
from torchrl import objectives
from torchrl.data import Unbounded

from ksim_rl.data import MASK_KEY
from ksim_rl.modules import QNetworkCfg, SquashedActorCfg, make_q_network, make_squashed_actor
from ksim_rl.objectives import SACLoss, TD3Loss, distributional, frozen
from ksim_rl.testing import count_syncs

BATCH, OBS, ACTION = 64, 5, 3
# What CUDA adds up by atomics, in the order in which threads come, and sums of floats whose blocks do.
UNORDERED = (
    "scatter_add",
    "scatter_reduce",
    "index_add",
    "index_put",
    "embedding_dense_backward",
    "cumsum",
)


class _OneOfN(nn.Module):
    """One network of the ensemble, for TorchRL."""

    def __init__(self, network, which):
        super().__init__()
        linear = [layer for layer in network.layers if hasattr(layer, "weight")]
        self.layers = nn.Sequential()
        for layer in linear:
            plain = nn.Linear(*layer.weight.shape[1:])
            plain.weight.data.copy_(layer.weight[which].T)
            plain.bias.data.copy_(layer.bias[which, 0])
            self.layers.append(plain).append(nn.ReLU())
        del self.layers[-1]

    def forward(self, obs, action):
        return self.layers(torch.cat((obs, action), -1))


def networks(num_atoms=1, low=-1.0, **fields):
    torch.manual_seed(0)
    actor = make_squashed_actor(
        SquashedActorCfg(
            hidden_dims=(16,), obs_normalization=False, output_gain=1.0, action_bound=-low
        ),
        obs_dim=OBS,
        action_spec=Unbounded((ACTION,)),
    )
    cfg = QNetworkCfg(hidden_dims=(16, 16), obs_normalization=False, num_atoms=num_atoms, **fields)
    return actor, make_q_network(cfg, obs_dim=OBS, action_dim=ACTION)


def minibatch():
    torch.manual_seed(1)
    data = {
        "actor": torch.randn(BATCH, OBS),
        "critic": torch.randn(BATCH, OBS),
        "action": torch.rand(BATCH, ACTION) * 2 - 1,
        ("next", "actor"): torch.randn(BATCH, OBS),
        ("next", "critic"): torch.randn(BATCH, OBS),
        ("next", "reward"): torch.randn(BATCH, 1),
        ("next", "done"): torch.rand(BATCH, 1) < 0.4,
        "steps_to_next_obs": torch.randint(1, 4, (BATCH, 1)),
    }
    data["next", "terminated"] = data["next", "done"] & (torch.rand(BATCH, 1) < 0.5)
    return TensorDict(data, [BATCH])


def with_extra(data, extra):
    """Add what replays may give beside the env states: a mask, or weights; "" adds nothing."""
    if extra == "mask":
        data[MASK_KEY] = torch.rand(BATCH, 1) < 0.7
    if extra == "weights":
        data["priority_weight"] = torch.rand(BATCH)
    return data


def for_torchrl(critic):
    """Return the networks of an ensemble, one by one."""
    return [
        TensorDictModule(
            _OneOfN(critic.module, which),
            in_keys=["critic", "action"],
            out_keys=["state_action_value"],
        )
        for which in range(critic.module.cfg.num_networks)
    ]


def move_targets(ours, stock):
    """Make the targets of both losses the same networks, other ones than the critics."""
    torch.manual_seed(5)
    for parameter in ours.target_critic_network.parameters():
        parameter.data.add_(0.1 * torch.randn_like(parameter))
    others = [dict(other.named_parameters()) for other in for_torchrl(ours.target_critic_network)]
    for key, value in stock.target_qvalue_network_params.items(True, True):
        value.data.copy_(torch.stack([other[".".join(key)] for other in others]))


def assert_gradients_are_alike(critic, stock):
    linear = [layer for layer in critic.module.layers if hasattr(layer, "weight")]
    for number, layer in enumerate(linear):
        weight = stock.qvalue_network_params.get(("module", "layers", str(2 * number), "weight"))
        torch.testing.assert_close(
            layer.weight.grad, weight.grad.transpose(1, 2), rtol=1e-5, atol=1e-6
        )


def _both(actor, critic, *, gamma=0.95, alpha=0.3, fixed=False, low=-1.0):
    ours = SACLoss(
        actor, critic, gamma=gamma, alpha_init=alpha, target_entropy=-2.5, learn_alpha=not fixed
    )
    plain = for_torchrl(critic)
    stock = objectives.SACLoss(
        actor_network=actor,
        qvalue_network=plain,
        num_qvalue_nets=len(plain),
        loss_function="l2",
        alpha_init=alpha,
        fixed_alpha=fixed,
        target_entropy=-2.5,
    )
    stock.make_value_estimator(gamma=gamma)
    move_targets(ours, stock)
    return ours, stock


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("low", [-1.0, -3.0])
@pytest.mark.parametrize("num_networks", [2, 3])
@pytest.mark.parametrize("extra", ["", "mask", "weights"])
@pytest.mark.parametrize("fixed", [False, True])
def test_losses_and_gradients_are_those_of_torchrl(low, num_networks, extra, fixed):
    actor, critic = networks(num_networks=num_networks, low=low)
    ours, stock = _both(actor, critic, fixed=fixed)
    data = with_extra(minibatch(), extra)
    results, gradients = [], []
    for loss in (ours, stock):
        torch.manual_seed(3)
        inputs = data.clone()
        out = loss(inputs)
        actor.zero_grad()
        total = sum(
            value for name, value in out.items() if name.startswith("loss_") and value.requires_grad
        )
        total.backward()
        results.append(out.select("loss_actor", "loss_qvalue", "loss_alpha", "alpha"))
        results[-1]["priority"] = inputs["td_error"]
        gradients.append([parameter.grad.clone() for parameter in actor.parameters()])
    for name in results[0].keys():
        torch.testing.assert_close(
            results[0][name], results[1][name], rtol=1e-5, atol=1e-6, msg=name
        )
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)
    assert_gradients_are_alike(critic, stock)
    if not fixed:
        torch.testing.assert_close(ours.log_alpha.grad, stock.log_alpha.grad)


def test_each_loss_reaches_its_own_network_alone():
    actor, critic = networks()
    loss = SACLoss(actor, critic, target_entropy=-3.0)
    for name, own in (
        ("loss_qvalue", list(critic.parameters())),
        ("loss_actor", list(actor.parameters())),
        ("loss_alpha", [loss.log_alpha]),
    ):
        loss.zero_grad(set_to_none=True)
        loss(minibatch())[name].backward()
        reached = {id(parameter) for parameter in loss.parameters() if parameter.grad is not None}
        assert reached == {id(parameter) for parameter in own}, name
        assert all(parameter.grad is None for parameter in loss.target_critic_network.parameters())


@pytest.mark.parametrize("num_atoms", [1, 11])
@pytest.mark.parametrize("value_reduction", ["min", "mean"])
def test_no_host_sync(num_atoms, value_reduction):
    actor, critic = networks(num_atoms)
    options = {"support_A": critic.module.support, "value_reduction": value_reduction}
    sac = SACLoss(actor, critic, target_entropy=-3.0, **options)
    td3 = TD3Loss(actor, critic, low_L=-torch.ones(ACTION), high_L=torch.ones(ACTION), **options)
    for loss in (sac, td3):
        data = minibatch()
        loss(data)
        with count_syncs() as syncs:
            losses = loss(data)
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            loss.update_target_(0.1)
        assert syncs.total == 0, syncs.report()


def test_targets_follow_and_share_the_statistics():
    cfg = QNetworkCfg(hidden_dims=(8,))
    critic = make_q_network(cfg, obs_dim=OBS, action_dim=ACTION)
    actor, _ = networks()
    loss = SACLoss(actor, critic, target_entropy=-3.0)
    target = loss.target_critic_network
    assert target.module.normalizer is critic.module.normalizer
    before = [parameter.clone() for parameter in target.parameters()]
    for parameter in critic.parameters():
        parameter.data.add_(torch.randn_like(parameter))
    loss.update_target_(0.25)
    for old, new, source in zip(before, target.parameters(), critic.parameters(), strict=True):
        torch.testing.assert_close(new, 0.75 * old + 0.25 * source)


@pytest.mark.filterwarnings("ignore:No target network updater")
def test_keys_can_be_renamed():
    actor, critic = networks()
    loss = SACLoss(actor, critic, target_entropy=-3.0)
    data = minibatch()
    torch.manual_seed(2)
    expected = loss(data.clone())
    renamed = data.clone()
    renamed["next", "gain"] = renamed.pop(("next", "reward"))
    loss.set_keys(reward="gain", priority="error")
    torch.manual_seed(2)
    result = loss(renamed)
    assert (result == expected).all()
    assert "error" in renamed.keys() and ("next", "gain") in loss.in_keys


# With norms it has all sums that it has without.
@pytest.mark.parametrize("layer_norm", [pytest.param(False, marks=pytest.mark.full), True])
def test_no_sum_of_a_compiled_step_is_without_an_order(layer_norm, monkeypatch):
    # On CUDA a kernel projects, in one order.
    monkeypatch.setattr(distributional, "project_distribution", lambda probs, *_: probs)
    actor, critic = networks(11, layer_norm=layer_norm)
    loss = SACLoss(actor, critic, target_entropy=-3.0, support_A=critic.module.support)
    found = []

    def note(graph, _):
        found.extend(str(node.target) for node in graph.graph.nodes if node.op == "call_function")
        return make_boxed_func(graph.forward)

    backend = aot_autograd(fw_compiler=note, decompositions=select_decomp_table())
    compiled = partial(torch.compile, backend=backend, fullgraph=True, dynamic=False)
    compiled(loss.critic_loss)(minibatch())[0].backward()
    with frozen(critic):
        losses = compiled(loss.actor_losses)(minibatch())[0]
    torch.autograd.backward(list(losses.values()))
    assert sum("mm" in name for name in found) > 10
    assert [name for name in found if any(kind in name for kind in UNORDERED)] == []


@pytest.mark.parametrize("num_atoms", [pytest.param(1, marks=pytest.mark.full), 11])
def test_the_compiler_follows_the_losses_in_one_graph(num_atoms):
    actor, critic = networks(num_atoms)
    loss = SACLoss(actor, critic, target_entropy=-3.0, support_A=critic.module.support)
    compiled = partial(torch.compile, backend="eager", fullgraph=True)
    torch.manual_seed(5)
    found = compiled(loss.critic_loss)(minibatch())[0]
    torch.manual_seed(5)
    torch.testing.assert_close(found, loss.critic_loss(minibatch())[0])
    torch.manual_seed(5)
    with frozen(critic):
        found = compiled(loss.actor_losses)(minibatch())[0]
    torch.manual_seed(5)
    expected = loss.actor_losses(minibatch())[0]
    torch.testing.assert_close(found, expected)
    found["loss_actor"].backward()
    assert all(parameter.grad is None for parameter in critic.parameters())
    assert all(parameter.grad is not None for parameter in actor.parameters())
