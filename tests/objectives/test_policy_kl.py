"""How far policies of every distribution move, in the loss that adapts the learning rate to it."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import distributions, nn
from torchrl import objectives
from torchrl.data import Bounded, Categorical, Composite
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, TruncatedNormal

from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import ClipPPOLoss, distribution_keys, observation_keys
from ksim_rl.objectives.policy_kl import estimated_kl, policy_kl
from ksim_rl.testing import count_syncs

BOX = Bounded(-2.0, 1.0, (1, 2))
SPECS = {
    "tanh_gaussian": BOX,
    "truncated_gaussian": BOX,
    "categorical": Categorical(3, shape=(1,)),
    "mixed": Composite(
        action=Composite(arm=BOX, grip=Categorical(3, shape=(1,)), shape=(1,)), shape=(1,)
    ),
}


def _problem(name, size=512):
    torch.manual_seed(0)
    kind = "tanh_gaussian" if name == "mixed" else name
    cfg = ActorCfg(hidden_dims=(8,), distribution=kind, init_std=0.5, output_gain=0.5)
    actor, critic = (
        make_actor(cfg, obs_dim=5, action_spec=SPECS[name]),
        make_critic(CriticCfg(hidden_dims=(8,)), obs_dim=5),
    )
    data = TensorDict({"actor": torch.randn(size, 5), "critic": torch.randn(size, 5)}, [size])
    with torch.no_grad():
        critic(actor(data))
        data["advantage"], data["value_target"] = torch.randn(2, size, 1)
        old = actor.get_dist(data.clone())
        for parameter in actor.parameters():
            parameter.add_(0.03 * torch.randn_like(parameter))
    return actor, critic, data, old


def _action(data):
    return data["action"] if isinstance(data.get("action"), torch.Tensor) else data.select("action")


def _log_prob(dist, data):
    log_prob = dist.log_prob(_action(data))
    return sum(log_prob.values(True, True)) if isinstance(dist, CompositeDistribution) else log_prob


@pytest.mark.parametrize("name", SPECS)
def test_the_losses_kl_is_the_mean_log_ratio_of_samples(name):
    actor, critic, data, old = _problem(name)
    loss = ClipPPOLoss(actor, critic, functional=False)
    kl = loss(data.select(*loss.dataset_keys))["kl"].item()
    assert kl > 0.0
    new = actor.get_dist(data.clone())
    ratios = []
    with torch.no_grad():
        for _ in range(40):
            sample = old.sample()
            drawn = (
                sample if isinstance(sample, TensorDict) else TensorDict({"action": sample}, [512])
            )
            ratios.append(_log_prob(old, drawn) - _log_prob(new, drawn))
    ratios = torch.cat(ratios)
    assert abs(ratios.mean().item() - kl) < 4.0 * ratios.std().item() / ratios.numel() ** 0.5


@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("functional", [True, False])
def test_losses_equal_stock_torchrl(name, functional):
    actor, critic, data, _ = _problem(name, size=64)
    outs = []
    for cls in (ClipPPOLoss, objectives.ClipPPOLoss):
        torch.manual_seed(1)  # for the entropy's sample
        outs.append(cls(actor, critic, functional=functional)(data.clone()))
    for key in ("loss_objective", "loss_critic", "loss_entropy", "entropy", "kl_approx"):
        torch.testing.assert_close(outs[0][key], outs[1][key], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    "name",
    [name if name == "mixed" else pytest.param(name, marks=pytest.mark.full) for name in SPECS],
)
def test_no_host_sync_and_compiles_without_a_break(name):
    actor, critic, data, _ = _problem(name, size=16)
    loss = ClipPPOLoss(
        actor, critic, functional=False, log_ratio_statistics=False, loss_critic_type="l2"
    )
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(data.clone())
    with count_syncs() as syncs:
        eager = loss(data.clone())
        sum(value for key, value in eager.items() if key.startswith("loss_")).backward()
    assert syncs.total == 0, syncs.report()
    for key in ("loss_objective", "loss_critic", "kl"):
        torch.testing.assert_close(compiled[key], eager[key])


def test_what_an_actor_reads_and_writes():
    mixed = _problem("mixed", size=4)[0]
    assert observation_keys(mixed) == ["actor"]
    assert set(distribution_keys(mixed)) == {
        ("params", "action", "arm", "loc"),
        ("params", "action", "arm", "scale"),
        ("params", "action", "grip", "logits"),
    }
    foreign = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()), ["pixels"], ["mean", "spread"]
        ),
        in_keys={"loc": "mean", "scale": "spread"},
        distribution_class=TanhNormal,
    )
    assert observation_keys(foreign) == ["pixels"] and set(distribution_keys(foreign)) == {
        "mean",
        "spread",
    }


def test_foreign_distributions_are_measured_exactly_or_not_at_all():
    loc, scale = torch.randn(6, 3), torch.rand(6, 3) + 0.1
    gaussians = [
        distributions.Independent(distributions.Normal(loc + shift, scale), 1)
        for shift in (0.0, 0.1)
    ]
    expected = distributions.kl_divergence(*gaussians)
    torch.testing.assert_close(policy_kl(*gaussians), expected)
    squashed = [TanhNormal(loc + shift, scale) for shift in (0.0, 0.1)]
    with count_syncs() as syncs:
        divergence = policy_kl(*squashed)
    assert syncs.total == 0, syncs.report()
    torch.testing.assert_close(divergence, expected)
    truncated = [TruncatedNormal(loc + shift, scale) for shift in (0.0, 0.1)]
    assert policy_kl(*truncated) is None


def test_the_estimate_is_unbiased_and_never_negative():
    torch.manual_seed(0)
    old, new = distributions.Normal(0.0, 1.0), distributions.Normal(0.3, 1.2)
    sample = old.sample((100_000,))
    estimate = estimated_kl(new.log_prob(sample) - old.log_prob(sample))
    assert estimate.min() >= 0.0
    error = estimate.std() / 100_000**0.5
    assert abs(estimate.mean() - distributions.kl_divergence(old, new)) < 4.0 * error
