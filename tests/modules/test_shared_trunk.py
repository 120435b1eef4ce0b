"""Actor and critic on shared layers, against TorchRL's own operator and against the same layers by hand."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl import objectives
from torchrl.modules import ActorValueOperator, ProbabilisticActor, ValueOperator

from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    DiagonalGaussian,
    SharedTrunkCfg,
    make_actor,
    make_critic,
    make_shared_trunk,
    update_normalizers,
)
from ksim_rl.objectives import PPOCfg, make_loss, make_optimizer
from ksim_rl.testing import count_syncs


@pytest.fixture
def operator():
    torch.manual_seed(0)
    trunk = make_shared_trunk(SharedTrunkCfg(hidden_dims=(16, 8)), obs_dim=5)
    options = {"hidden_dims": (6,), "obs_normalization": False, "in_keys": ("features",)}
    actor = make_actor(ActorCfg(**options, output_gain=0.5), obs_dim=8, action_dim=2)
    return ActorValueOperator(trunk, actor, make_critic(CriticCfg(**options), obs_dim=8))


def _minibatch(actor, size=32):
    data = actor(TensorDict({"actor": torch.randn(size, 5)}, [size])).detach().exclude("features")
    data["advantage"], data["value_target"] = torch.randn(2, size, 1)
    data["state_value"] = torch.zeros(size, 1)
    data["actor"] = data["actor"] + 0.1
    return data


def _stock(operator):
    """Return the same numbers from torch's and TorchRL's modules only."""
    trunk, actor, critic = operator.module[0], operator.module[1], operator.module[2]
    policy, value = actor.module[0].module, critic.module

    class Heads(nn.Module):
        def __init__(self):
            super().__init__()
            self.hidden, self.loc, self.std = policy.trunk, policy.head.loc, policy.head.std

        def forward(self, features):
            loc = self.loc(self.hidden(features))
            return loc, self.std.expand_as(loc)

    return ActorValueOperator(
        TensorDictModule(
            nn.Sequential(trunk.module.normalizer, trunk.module.layers),
            in_keys=["actor"],
            out_keys=["features"],
        ),
        ProbabilisticActor(
            TensorDictModule(Heads(), in_keys=["features"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=DiagonalGaussian,
            return_log_prob=True,
        ),
        ValueOperator(value.layers, in_keys=["features"]),
    )


def test_losses_and_gradients_equal_those_of_stock_modules_and_loss(operator):
    stock = _stock(operator)
    data = _minibatch(operator.get_policy_operator())
    cfg = PPOCfg(normalize_advantage="none", clip_value=False)
    ours = make_loss(cfg, operator.get_policy_operator(), operator.get_value_operator())
    theirs = objectives.ClipPPOLoss(
        stock.get_policy_operator(),
        stock.get_value_operator(),
        clip_epsilon=cfg.clip_epsilon,
        entropy_coeff=cfg.entropy_coeff,
        loss_critic_type="l2",
        functional=False,
    )
    trunk, gradients = list(operator.module[0].parameters()), []
    for loss in (ours, theirs):
        out = loss(data.clone())
        total = sum(value for name, value in out.items() if name.startswith("loss_"))
        gradients.append(torch.autograd.grad(total, trunk))
        torch.testing.assert_close(out["loss_critic"], ours(data.clone())["loss_critic"])
        torch.testing.assert_close(out["loss_objective"], ours(data.clone())["loss_objective"])
    for one, other in zip(*gradients, strict=True):
        assert one.abs().sum() > 0
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


def test_shared_parameters_are_optimized_once_and_observations_counted_once(operator):
    actor, critic = operator.get_policy_operator(), operator.get_value_operator()
    optimizer = make_optimizer(PPOCfg(), actor, critic)
    listed = [id(parameter) for group in optimizer.param_groups for parameter in group["params"]]
    assert len(listed) == len(set(listed)) == len(list(operator.parameters()))
    update_normalizers(TensorDict({"actor": torch.randn(4, 6, 5)}, [4, 6]), actor, critic)
    assert int(operator.module[0].module.normalizer.count) == 24


@pytest.mark.full
def test_no_host_sync_and_compiles_without_a_break(operator):
    actor = operator.get_policy_operator()
    loss = make_loss(PPOCfg(), actor, operator.get_value_operator())
    data = _minibatch(actor)
    with count_syncs() as syncs:
        expected = loss(data.clone())
    assert syncs.total == 0, syncs.report()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(data.clone())
    for name, value in expected.items():
        torch.testing.assert_close(compiled[name], value)


def test_layers_there_must_be():
    with pytest.raises(ValueError, match=r"hidden_dims=\(\)"):
        SharedTrunkCfg(hidden_dims=())
