"""Options of `ClipPPOLoss`: the same losses and gradients as TorchRL's, or a closed form, or a refusal."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torchrl import objectives
from torchrl.modules import NormalParamExtractor, ProbabilisticActor
from torchrl.modules.value_norm import RunningValueNorm
from torchrl.objectives import SoftUpdate

from ksim_rl.objectives import GAE, ClipPPOLoss
from tests.objectives.problems import ACTOR_DIM, minibatch, networks, rollout
from tests.objectives.stock import both, same

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")


@pytest.mark.parametrize(
    "options",
    [
        {"normalize_advantage": True, "normalize_advantage_exclude_dims": (1,)},
        {
            "normalize_advantage": True,
            "clip_epsilon": (0.1, 0.25),
            "clip_value": 0.4,
            "loss_critic_type": "l2",
        },
        {"critic_coeff": None, "entropy_coeff": None},
        {"log_explained_variance": False},
        {"delay_actor": True, "max_importance_ratio": 1.1},
        {"samples_mc_entropy": 3},
        {"clip_value": torch.tensor(0.5)},
    ],
    ids=str,
)
def test_options_agree_with_stock(options):
    actor, critic = networks()
    data = GAE(gamma=0.9, lmbda=0.9, critic=critic)(rollout(actor))
    with torch.no_grad():
        for parameter in (*actor.parameters(), *critic.parameters()):
            parameter.add_(0.1 * torch.randn_like(parameter))
    same(*both(actor, critic, **options), data)


def test_a_running_norm_of_the_advantage_agrees_with_stock():
    actor, critic = networks()
    data = minibatch(actor, critic)
    losses = [
        cls(actor, critic, advantage_norm=RunningValueNorm(shape=1))
        for cls in (ClipPPOLoss, objectives.ClipPPOLoss)
    ]
    same(*losses, data)


def test_a_proximal_policy_that_follows_agrees_with_stock():
    actor, critic = networks()
    data = minibatch(actor, critic)
    losses = both(actor, critic, delay_actor=True)
    updaters = [SoftUpdate(loss, eps=0.5) for loss in losses]
    for _ in range(3):
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
        outs = same(*losses, data)
        for updater in updaters:
            updater.step()
    assert outs[0]["clip_fraction"] > 0


def test_entropy_coefficients_by_head_agree_with_stock():
    _, critic = networks()
    net = nn.Sequential(nn.Linear(ACTOR_DIM, 4), NormalParamExtractor())
    keys = [("params", name, kind) for name in ("arm", "leg") for kind in ("loc", "scale")]

    class TwoHeads(nn.Module):
        def __init__(self):
            super().__init__()
            self.net = net

        def forward(self, obs):
            return (*self.net(obs), *self.net(-obs))

    actor = ProbabilisticActor(
        TensorDictModule(TwoHeads(), in_keys=["actor"], out_keys=keys),
        in_keys=["params"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={
            "distribution_map": {
                name: lambda loc, scale: torch.distributions.Independent(
                    torch.distributions.Normal(loc, scale), 1
                )
                for name in ("arm", "leg")
            }
        },
        return_log_prob=True,
        default_interaction_type="random",
    )
    data = minibatch(actor, critic)
    coefficients = {"arm_entropy": 0.1, "leg_entropy": 0.02}
    outs = same(*both(actor, critic, entropy_coeff=coefficients), data)
    entropy = outs[0]["composite_entropy"]
    expected = -sum(weight * entropy[name].mean() for name, weight in coefficients.items())
    torch.testing.assert_close(outs[0]["loss_entropy"], expected)


def test_both_bounds_of_the_ratio_have_their_closed_form_and_can_be_scheduled():
    actor, critic = networks()
    data = minibatch(actor, critic)
    with torch.no_grad():
        log_prob = actor.get_dist(data.clone()).log_prob(data["action"])
    data["advantage"].fill_(1.0)
    for clip_epsilon, ratio, expected in (
        (0.2, 1.25, 1.2), ((0.2, 0.28), 1.25, 1.25), ((0.2, 0.28), 1.4, 1.28), (0.2, 0.5, 0.5)
    ):  # fmt: skip
        data["action_log_prob"] = log_prob - torch.tensor(ratio).log()
        loss = ClipPPOLoss(actor, critic, clip_epsilon=clip_epsilon)
        assert loss(data.clone())["loss_objective"].item() == pytest.approx(-expected, rel=1e-5)
    data["advantage"].fill_(-1.0)
    for ratio, expected in ((1.25, 1.25), (0.5, 0.8)):
        data["action_log_prob"] = log_prob - torch.tensor(ratio).log()
        loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2)
        assert loss(data.clone())["loss_objective"].item() == pytest.approx(expected, rel=1e-5)
    loss.clip_epsilon = 0.6
    assert loss(data.clone())["loss_objective"].item() == pytest.approx(0.5, rel=1e-5)


def test_clipping_the_value_needs_the_old_value():
    actor, critic = networks()
    data = minibatch(actor, critic).exclude("state_value")
    with pytest.raises(KeyError, match="state_value"):
        ClipPPOLoss(actor, critic, clip_value=0.2)(data)
    with pytest.raises(KeyError, match="action_log_prob"):
        ClipPPOLoss(actor, critic)(data.exclude("action_log_prob"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"clip_epsilon": (0.1, 0.2, 0.3)}, "length 2"),
        ({"clip_epsilon": (-0.1, 0.2)}, "non-negative"),
        ({"max_importance_ratio": 0.0}, "max_importance_ratio"),
        ({"delay_actor": True, "functional": False}, "functional=True"),
        ({"reduction": "median"}, None),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    actor, critic = networks()
    with pytest.raises((ValueError, NotImplementedError), match=message):
        ClipPPOLoss(actor, critic, **options)(minibatch(actor, critic))


def test_a_critic_is_optional():
    actor, critic = networks()
    data = minibatch(actor, critic)
    for loss in (
        ClipPPOLoss(actor, None, critic_coeff=0.0),
        objectives.ClipPPOLoss(actor, None, critic_coeff=0.0),
    ):
        out = loss(TensorDict(data))
        assert "loss_critic" not in out and "loss_objective" in out
