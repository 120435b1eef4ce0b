"""PPO of several actions, of an action of several parts, and with a critic of several values, as TorchRL's own."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    set_composite_lp_aggregate,
)
from torch import nn
from torchrl import objectives
from torchrl.modules import NormalParamExtractor

from ksim_rl.objectives import ClipPPOLoss


def _heads():
    """Return a policy with two heads, a critic, and data of the first."""
    parts = []
    for name, width in (("one", 2), ("two", 3)):
        net = nn.Sequential(nn.Linear(4, 2 * width), NormalParamExtractor())
        keys = {
            "in_keys": ["obs"],
            "out_keys": [("params", name, "loc"), ("params", name, "scale")],
        }
        parts.append(TensorDictModule(net, **keys))

    def independent(loc, scale):
        return torch.distributions.Independent(torch.distributions.Normal(loc, scale), 1)

    head = ProbabilisticTensorDictModule(
        in_keys=["params"],
        out_keys=["one", "two"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={"distribution_map": {"one": independent, "two": independent}},
        return_log_prob=True,
    )
    actor = ProbabilisticTensorDictSequential(*parts, head)
    data = TensorDict({"obs": torch.randn(6, 4)}, [6])
    with torch.no_grad():
        actor(data)
    data.update({"advantage": torch.randn(6, 1), "value_target": torch.randn(6, 1)})
    return actor, TensorDictModule(nn.Linear(4, 1), ["obs"], ["state_value"]), data


def _both(actor, critic, data, **options):
    keys = {"action": ["one", "two"], "sample_log_prob": ["one_log_prob", "two_log_prob"]}
    found = []
    for kind in (objectives.ClipPPOLoss, ClipPPOLoss):
        loss = kind(actor, critic, **options)
        loss.set_keys(**keys)
        found.append(loss(data.clone()))
    return found


@pytest.mark.parametrize("suffix", ["entropy", "log_prob"])
def test_entropy_has_a_coefficient_by_head(suffix):
    with set_composite_lp_aggregate(False):
        actor, critic, data = _heads()
        coefficients = {"one_entropy": 0.1, "two_entropy": 0.5}
        (expected, _) = _both(actor, critic, data, entropy_coeff=coefficients)
        named = {f"one_{suffix}": 0.1, f"two_{suffix}": 0.5}
        loss = ClipPPOLoss(actor, critic, entropy_coeff=named)
        loss.set_keys(action=["one", "two"], sample_log_prob=["one_log_prob", "two_log_prob"])
        out = loss(data.clone())
    torch.testing.assert_close(out["loss_entropy"], expected["loss_entropy"])
    entropies = out["composite_entropy"]
    by_hand = -(0.1 * entropies["one_entropy"] + 0.5 * entropies["two_entropy"]).mean()
    torch.testing.assert_close(out["loss_entropy"], by_hand)


def test_an_advantage_counts_for_each_part_of_an_action():
    class TokenActor(nn.Module):
        in_keys = ("logits",)

        def __init__(self):
            super().__init__()
            self.bias = nn.Parameter(torch.zeros(4))

        def get_dist(self, tensordict):
            return torch.distributions.Categorical(logits=tensordict["logits"] + self.bias)

    logits = torch.randn(6, 3, 4)
    action = torch.randint(4, (6, 3))
    log_prob = torch.distributions.Categorical(logits=logits).log_prob(action) + 0.3 * torch.randn(
        6, 3
    )
    data = TensorDict(
        {
            "logits": logits,
            "action": action,
            "sample_log_prob": log_prob,
            "advantage": torch.randn(6, 1),
        },
        [6],
    )
    data.update({"obs": torch.randn(6, 4), "value_target": torch.randn(6, 1)})
    critic = TensorDictModule(nn.Linear(4, 1), ["obs"], ["state_value"])
    found = []
    for kind in (objectives.ClipPPOLoss, ClipPPOLoss):
        loss = kind(TokenActor(), critic, entropy_bonus=False)
        loss.set_keys(action="action", sample_log_prob="sample_log_prob", advantage="advantage")
        found.append(loss(data.clone()))
    for key in ("loss_objective", "loss_critic", "clip_fraction", "kl_approx", "ESS"):
        torch.testing.assert_close(found[1][key], found[0][key])
    ratio = (torch.distributions.Categorical(logits=logits).log_prob(action) - log_prob).exp()
    gain = torch.minimum(ratio * data["advantage"], ratio.clamp(0.8, 1.2) * data["advantage"])
    torch.testing.assert_close(found[1]["loss_objective"], -gain.mean())


def test_a_critic_may_give_several_values():
    actor, _, data = _heads()
    critic = TensorDictModule(
        lambda obs: (obs[..., :1], obs[..., 1:2]),
        ["obs"],
        [("state_value", "a"), ("state_value", "b")],
    )
    targets = TensorDict({"a": torch.randn(6, 1), "b": torch.randn(6, 1)}, [6])
    data.set("value_target", targets)
    with set_composite_lp_aggregate(False):
        expected, out = _both(actor, critic, data, loss_critic_type="l2")
    for name, column in (("a", 0), ("b", 1)):
        by_hand = (targets[name] - data["obs"][:, column : column + 1]).square()
        torch.testing.assert_close(out["loss_critic", name], by_hand)
        torch.testing.assert_close(out["loss_critic", name], expected["loss_critic", name])
