import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    TensorDictModule,
)
from torch import nn
from torchrl import objectives
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator

from ksim_rl.data import DatasetBuffer, DatasetCfg
from ksim_rl.objectives import GAE, ClipPPOLoss, kl_divergence
from ksim_rl.testing import count_syncs
from tests.objectives.problems import ACTION_DIM, ACTOR_DIM, minibatch, networks, rollout

OPTIONS = [
    {},
    {"clip_value": True},
    {"clip_value": 0.1, "loss_critic_type": "l2"},
    {"clip_value": 0.1, "loss_critic_type": "smooth_l1", "clip_epsilon": (0.1, 0.3)},
    {
        "normalize_advantage": True,
        "entropy_coeff": 0.05,
        "critic_coeff": 0.7,
        "loss_critic_type": "l1",
    },
    {"entropy_bonus": False, "critic_coeff": 0.0},
    {"reduction": "sum", "clip_value": 0.3},
    {"reduction": "none", "clip_value": 0.3},
    {"separate_losses": True},
    {"max_importance_ratio": 1.05},
    {"delay_actor": True},
    {"functional": False},
]


class _TwiceTheOutputs(nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, obs):
        return (*self.net(obs), *self.net(-obs))


def _total(out):
    return sum(value.sum() for name, value in out.items() if name.startswith("loss_"))


def _like_ours(key, value):
    # Each number that we log has shape [], this one of TorchRL's has [1].
    return value.squeeze(-1) if key == "explained_variance" else value


def _compare(ours, stock, data):
    gradients = []
    outs = []
    for loss in (ours, stock):
        out = loss(data.clone())
        parameters = [parameter for parameter in loss.parameters() if parameter.requires_grad]
        gradients.append(torch.autograd.grad(_total(out), parameters, allow_unused=True))
        outs.append(out)
    assert set(outs[1].keys()) <= set(outs[0].keys())
    for key in outs[1].keys():
        torch.testing.assert_close(
            outs[0][key],
            _like_ours(key, outs[1][key]),
            atol=1e-6,
            rtol=1e-6,
            msg=lambda text, key=key: f"{key}: {text}",
        )
    assert any(gradient is not None for gradient in gradients[1])
    for one, other in zip(*gradients, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_losses_and_gradients_equal_stock_torchrl(options):
    actor, critic = networks()
    data = minibatch(actor, critic)
    _compare(
        ClipPPOLoss(actor, critic, **options),
        objectives.ClipPPOLoss(actor, critic, **options),
        data,
    )


def test_equals_stock_where_the_value_estimator_makes_the_advantage():
    actor, critic = networks()
    data = rollout(actor)
    # TorchRL's explained variance of a rollout has one number per step of time, ours is over all env states.
    options = {"clip_value": 0.2, "log_explained_variance": False}
    losses = [cls(actor, critic, **options) for cls in (ClipPPOLoss, objectives.ClipPPOLoss)]
    for loss in losses:
        loss.make_value_estimator(GAE(gamma=0.9, lmbda=0.9, critic=critic))
    _compare(*losses, data)


def test_equals_stock_for_a_squashed_policy():
    _, critic = networks()
    net = nn.Sequential(nn.Linear(ACTOR_DIM, 2 * ACTION_DIM), NormalParamExtractor())
    squashed = ProbabilisticActor(
        TensorDictModule(net, in_keys=["actor"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
        default_interaction_type="random",
    )
    data = minibatch(squashed, critic)
    torch.manual_seed(1)
    ours = ClipPPOLoss(squashed, critic)(data.clone())
    torch.manual_seed(1)
    stock = objectives.ClipPPOLoss(squashed, critic)(data.clone())
    for key in stock.keys():
        torch.testing.assert_close(ours[key], _like_ours(key, stock[key]), atol=1e-6, rtol=1e-6)
    assert ours["kl"] > 0


def test_equals_stock_for_a_composite_policy():
    _, critic = networks()
    net = nn.Sequential(nn.Linear(ACTOR_DIM, 4), NormalParamExtractor())
    keys = [("params", name, kind) for name in ("arm", "leg") for kind in ("loc", "scale")]
    composite = ProbabilisticActor(
        TensorDictModule(_TwiceTheOutputs(net), in_keys=["actor"], out_keys=keys),
        in_keys=["params"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={
            "distribution_map": dict.fromkeys(("arm", "leg"), torch.distributions.Normal)
        },
        return_log_prob=True,
        default_interaction_type="random",
    )
    data = minibatch(composite, critic)
    _compare(ClipPPOLoss(composite, critic), objectives.ClipPPOLoss(composite, critic), data)


def test_clipped_value_loss_is_that_of_rsl_rl():
    actor, critic = networks()
    data = minibatch(actor, critic)
    loss = ClipPPOLoss(actor, critic, clip_value=0.2, critic_coeff=1.5, loss_critic_type="l2")(
        data.clone()
    )
    value, old, target = (
        critic(data.clone())["state_value"],
        data["state_value"],
        data["value_target"],
    )
    clipped = old + (value - old).clamp(-0.2, 0.2)
    expected = 1.5 * torch.maximum((value - target).square(), (clipped - target).square()).mean()
    torch.testing.assert_close(loss["loss_critic"], expected)
    assert 0.0 < loss["value_clip_fraction"] < 1.0


def test_kl_is_that_between_the_stored_and_the_present_policy():
    actor, critic = networks()
    data = minibatch(actor, critic)
    loss = ClipPPOLoss(actor, critic)
    present = actor(data.clone())
    expected = kl_divergence(data["loc"], data["scale"], present["loc"], present["scale"]).mean()
    out = loss(data.clone())
    torch.testing.assert_close(out["kl"], expected.detach())
    assert out["kl"] > 0
    assert not out["kl"].requires_grad


def test_without_a_closed_form_or_the_parameters_the_kl_is_an_estimate():
    actor, critic = networks()
    data = minibatch(actor, critic, size=20_000, drift=0.02)
    loss = ClipPPOLoss(actor, critic)
    exact, estimate = loss(data.clone())["kl"], loss(data.exclude("loc", "scale"))["kl"]
    assert estimate.item() == pytest.approx(exact.item(), rel=0.1)
    assert estimate >= 0 and not torch.equal(exact, estimate)


def test_only_losses_carry_gradients():
    actor, critic = networks()
    out = ClipPPOLoss(actor, critic, clip_value=0.2)(minibatch(actor, critic))
    for name, value in out.items():
        assert value.shape == ()
        assert value.requires_grad == name.startswith("loss_"), name


@pytest.mark.parametrize("normalize_advantage", [False, True])
@pytest.mark.parametrize("cls", [ClipPPOLoss, objectives.ClipPPOLoss])
def test_a_removed_row_contributes_to_no_gradient(cls, normalize_advantage):
    if normalize_advantage and cls is objectives.ClipPPOLoss:
        pytest.skip("stock TorchRL normalizes over masked rows too")
    actor, critic = networks()
    data = minibatch(actor, critic, size=12)
    dirty = data.clone()
    dirty["critic"][3, 2] = float("nan")
    dirty["advantage"][7] = float("inf")
    dataset = DatasetBuffer(DatasetCfg(num_env_states_per_minibatch=12, num_minibatches=1))
    dataset.extend(dirty)
    without = data[[row for row in range(12) if row not in (3, 7)]]
    loss = cls(
        actor,
        critic,
        clip_value=0.2,
        loss_critic_type="l2",
        normalize_advantage=normalize_advantage,
    )
    parameters = list(loss.parameters())
    outs = [loss(dataset.sample()), loss(without)]
    gradients = [torch.autograd.grad(_total(out), parameters) for out in outs]
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)
    if cls is ClipPPOLoss:
        for name in (
            "loss_objective",
            "loss_critic",
            "kl",
            "kl_approx",
            "clip_fraction",
            "entropy",
        ):
            torch.testing.assert_close(outs[0][name], outs[1][name], atol=1e-6, rtol=1e-5)


def test_no_row_left_gives_zero_loss_and_finite_gradients():
    actor, critic = networks()
    data = minibatch(actor, critic, size=6)
    data["actor"].fill_(float("nan"))
    dataset = DatasetBuffer(DatasetCfg(num_env_states_per_minibatch=6, num_minibatches=1))
    dataset.extend(data)
    loss = ClipPPOLoss(actor, critic, functional=False)
    total = _total(loss(dataset.sample()))
    total.backward()
    assert total.item() == 0.0
    assert all(parameter.grad.abs().sum() == 0.0 for parameter in loss.parameters())


def _masked_minibatch(actor, critic):
    data = minibatch(actor, critic)
    data["collector", "mask"] = torch.rand(64, 1) < 0.9
    return data


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize(
    "options",
    [
        {"clip_value": 0.2, "loss_critic_type": "l2"},
        {
            "normalize_advantage": True,
            "log_ratio_statistics": False,
            "log_explained_variance": False,
        },
    ],
    ids=["clip_value", "normalize"],
)
def test_no_host_sync(options, functional):
    actor, critic = networks()
    data = _masked_minibatch(actor, critic)
    loss = ClipPPOLoss(actor, critic, functional=functional, **options)
    with count_syncs() as syncs:
        _total(loss(data)).backward()
    assert syncs.total == 0, syncs.report()


# TorchRL's functional parameters take the compiler long to trace.
@pytest.mark.parametrize("functional", [False, pytest.param(True, marks=pytest.mark.full)])
def test_compiles_without_a_break(functional):
    actor, critic = networks()
    data = _masked_minibatch(actor, critic)
    loss = ClipPPOLoss(
        actor, critic, functional=functional, clip_value=0.2, normalize_advantage=True
    )
    expected = loss(data.clone())
    _total(expected).backward()
    gradients = [parameter.grad.clone() for parameter in loss.parameters()]
    loss.zero_grad()
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(data.clone())
    _total(compiled).backward()
    for name, value in expected.items():
        torch.testing.assert_close(compiled[name], value)
    for parameter, gradient in zip(loss.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_the_normalizer_inside_is_the_one_that_is_updated():
    actor, critic = networks()
    data = minibatch(actor, critic)
    losses = [ClipPPOLoss(actor, critic, functional=functional) for functional in (True, False)]
    before = [loss(data.clone())["kl"] for loss in losses]
    actor.module[0].module.normalizer.update(data["actor"] * 10 + 3)
    after = [loss(data.clone())["kl"] for loss in losses]
    assert before[0] != after[0]
    torch.testing.assert_close(before[0], before[1])
    torch.testing.assert_close(after[0], after[1])


def test_dataset_keys_are_enough():
    actor, critic = networks()
    loss = ClipPPOLoss(actor, critic, clip_value=0.2)
    data = minibatch(actor, critic)
    selected = data.select(*loss.dataset_keys)
    assert set(selected.keys(True, True)) == set(loss.dataset_keys)
    torch.testing.assert_close(loss(selected)["kl"], loss(data)["kl"])


def test_any_tensordict_modules_with_the_right_keys_work():
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(nn.Linear(3, 4), NormalParamExtractor()),
            in_keys=["pixels"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=torch.distributions.Normal,
        return_log_prob=False,
        distribution_kwargs={"validate_args": False},
    )
    critic = ValueOperator(nn.Linear(3, 1), in_keys=["pixels"])
    loss = ClipPPOLoss(actor, critic)
    assert set(loss.dataset_keys) >= {
        "pixels",
        "action",
        "loc",
        "scale",
        "advantage",
        "value_target",
    }


@pytest.mark.parametrize(
    ("options", "message"),
    [({"clip_value": True, "clip_epsilon": (0.1, 0.2)}, r"clip_value=True.*\(0.1, 0.2\)")],
)
def test_options_that_contradict_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ClipPPOLoss(*networks(), **options)


def test_an_advantage_without_its_last_dim_is_refused():
    actor, critic = networks()
    data = minibatch(actor, critic)
    data["advantage"] = data["advantage"].squeeze(-1)
    with pytest.raises((ValueError, RuntimeError)):
        ClipPPOLoss(actor, critic)(data)


def test_clip_value_false_and_none_do_not_clip():
    actor, critic = networks()
    data = minibatch(actor, critic)
    for clip_value in (False, None, 0.0):
        out = ClipPPOLoss(actor, critic, clip_value=clip_value)(TensorDict(data))
        assert "value_clip_fraction" not in out
