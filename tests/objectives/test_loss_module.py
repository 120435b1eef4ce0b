"""What TorchRL's own tests ask of each of its losses, asked of `ClipPPOLoss` and compared with the stock one."""

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl import objectives
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, ValueOperator
from torchrl.objectives import ValueEstimators

from ksim_rl.objectives import GAE, ClipPPOLoss, TDLambda, VTrace
from tests.objectives.problems import ACTION_DIM, ACTOR_DIM, minibatch, networks, rollout
from tests.objectives.stock import LOSSES, both, same

pytestmark = pytest.mark.filterwarnings("ignore:No target network updater")

KEYS = {
    "advantage": "advantage",
    "value_target": "value_target",
    "value": "state_value",
    "sample_log_prob": "action_log_prob",
    "action": "action",
    "reward": "reward",
    "done": "done",
    "terminated": "terminated",
}

# -- keys ----------------------------------------------------------------------------------------------------------


def test_keys_have_their_defaults_can_be_set_and_unknown_ones_are_refused():
    loss = ClipPPOLoss(*networks())
    assert {name: getattr(loss.tensor_keys, name) for name in KEYS} == KEYS
    for name in KEYS:
        loss.set_keys(**{name: "other"})
        assert getattr(loss.tensor_keys, name) == "other"
        loss.set_keys(**{name: None})
        assert getattr(loss.tensor_keys, name) == KEYS[name]
    with pytest.raises(ValueError, match="unknown"):
        loss.set_keys(unknown="other")


@pytest.mark.parametrize("kind", [GAE, TDLambda, VTrace, *ValueEstimators])
def test_keys_reach_the_value_estimator(kind):
    actor, critic = networks()
    loss = ClipPPOLoss(actor, critic)
    new = {
        "advantage": "gain",
        "value_target": "goal",
        "reward": "pay",
        "done": "over",
        "terminated": "dead",
    }
    if kind in (GAE, TDLambda):
        kind = kind(gamma=0.9, lmbda=0.9, critic=critic)
    elif kind is VTrace:
        kind = VTrace(gamma=0.9, actor=actor, critic=critic)
    loss.make_value_estimator(kind)
    loss.set_keys(**new)
    for name, key in new.items():
        assert getattr(loss.value_estimator.tensor_keys, name) == key


def test_all_keys_of_the_data_may_have_other_names():
    actor, critic = networks()
    data = rollout(actor)
    loss = ClipPPOLoss(actor, critic, clip_value=0.2)
    loss.make_value_estimator(GAE(gamma=0.9, lmbda=0.9, critic=critic))
    expected = loss(data.clone())
    net = actor.module[0].module
    renamed = {
        "reward": "pay",
        "done": "over",
        "terminated": "dead",
        "sample_log_prob": "log_p",
        "action": "act",
    }
    other_actor = ProbabilisticActor(
        TensorDictModule(net, in_keys=["actor"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=["act"],
        distribution_class=type(actor.get_dist(data)),
        return_log_prob=True,
        log_prob_key="log_p",
    )
    other = ClipPPOLoss(other_actor, critic, clip_value=0.2)
    other.set_keys(**renamed)
    other.make_value_estimator(GAE(gamma=0.9, lmbda=0.9, critic=critic))
    other.set_keys(**renamed)
    moved = data.clone()
    moved.rename_key_("action", "act").rename_key_("action_log_prob", "log_p")
    moved["next"].rename_key_("reward", "pay").rename_key_("done", "over").rename_key_(
        "terminated", "dead"
    )
    for name in LOSSES:
        torch.testing.assert_close(other(moved.clone())[name], expected[name])


# -- parameters ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("functional", [True, False])
def test_each_loss_trains_its_own_network(functional):
    actor, critic = networks()
    loss = ClipPPOLoss(actor, critic, functional=functional, loss_critic_type="l2")
    out = loss(minibatch(actor, critic))
    for names, trained, left in (
        (["loss_critic"], "critic", "actor"),
        (["loss_objective", "loss_entropy"], "actor", "critic"),
    ):
        loss.zero_grad()
        sum(out[name] for name in names).backward(retain_graph=True)
        for name, parameter in loss.named_parameters():
            if name.startswith(trained):
                assert parameter.grad is not None and parameter.grad.norm() > 0, name
            if name.startswith(left):
                assert parameter.grad is None or parameter.grad.norm() == 0, name


def test_resetting_parameters_changes_them_all():
    actor, critic = networks(obs_normalization=False)
    loss = ClipPPOLoss(actor, critic)
    linear = [
        p
        for m in (*actor.modules(), *critic.modules())
        if isinstance(m, nn.Linear)
        for p in m.parameters()
    ]
    with torch.no_grad():
        for parameter in linear:
            parameter.add_(1000.0)
    before = [parameter.clone() for parameter in linear]
    loss.reset_parameters_recursive()
    assert all((old != new).any() for old, new in zip(before, linear, strict=True))


@pytest.mark.parametrize("functional", [True, False])
def test_a_state_dict_restores_the_loss(functional):
    actor, critic = networks()
    data = minibatch(actor, critic)
    loss = ClipPPOLoss(actor, critic, functional=functional, clip_epsilon=0.3)
    other_actor, other_critic = networks()
    other = ClipPPOLoss(other_actor, other_critic, functional=functional)
    assert not torch.allclose(
        loss(data.clone())["loss_objective"], other(data.clone())["loss_objective"]
    )
    other.load_state_dict(loss.state_dict())
    for name in LOSSES:
        torch.testing.assert_close(other(data.clone())[name], loss(data.clone())[name])
    stock = objectives.ClipPPOLoss(*networks(), functional=functional)
    assert set(loss.state_dict()) == set(stock.state_dict())


def test_moves_to_another_dtype_with_all_its_buffers():
    actor, critic = networks()
    data = minibatch(actor, critic)
    loss = ClipPPOLoss(actor, critic, clip_value=0.2, functional=False)
    expected = loss(data.clone())
    loss = loss.to(torch.float64)
    out = loss(data.apply(lambda leaf: leaf.double() if leaf.is_floating_point() else leaf))
    assert out["loss_objective"].dtype == torch.float64
    for name in LOSSES:
        torch.testing.assert_close(out[name].float(), expected[name], atol=1e-5, rtol=1e-5)


def _shared_networks():
    trunk = TensorDictModule(
        nn.Sequential(nn.Linear(ACTOR_DIM, 8), nn.Tanh()), ["actor"], ["hidden"]
    )
    head = TensorDictModule(
        nn.Sequential(nn.Linear(8, 2 * ACTION_DIM), NormalParamExtractor()),
        ["hidden"],
        ["loc", "scale"],
    )
    actor = ProbabilisticActor(
        TensorDictSequential(trunk, head),
        in_keys=["loc", "scale"],
        distribution_class=lambda loc, scale: torch.distributions.Independent(
            torch.distributions.Normal(loc, scale, validate_args=False), 1
        ),
        return_log_prob=True,
        default_interaction_type="random",
    )
    value = ValueOperator(nn.Linear(8, 1), in_keys=["hidden"])
    return trunk, actor, TensorDictSequential(trunk, value), value


@pytest.mark.parametrize("separate_losses", [True, False])
@pytest.mark.parametrize("functional", [True, False])
def test_a_shared_trunk_is_trained_by_the_critic_unless_losses_are_separate(
    separate_losses, functional
):
    trunk, actor, _, head = _shared_networks()
    data = rollout(actor, num_envs=16, length=1).reshape(-1)
    data["advantage"], data["value_target"] = torch.randn(16, 1), torch.randn(16, 1)
    options = {
        "separate_losses": separate_losses,
        "functional": functional,
        "loss_critic_type": "l2",
    }
    trained = []
    for loss in both(actor, head, **options):
        # The critic reads the trunk's output, which the actor writes.
        out = loss(data.clone())
        parameters = list(trunk.parameters())
        trained.append(torch.autograd.grad(out["loss_critic"], parameters, materialize_grads=True))
    assert all(bool((gradient == 0).all()) == separate_losses for gradient in trained[0])
    for one, other in zip(*trained, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("separate_losses", [True, False])
def test_one_pass_of_a_shared_trunk_gives_the_gradients_of_two(separate_losses):
    trunk, actor, critic, head = _shared_networks()
    data = rollout(actor, num_envs=16, length=1).reshape(-1)
    data["advantage"], data["value_target"] = torch.randn(16, 1), torch.randn(16, 1)
    gradients = []
    for value in (critic, head):
        loss = ClipPPOLoss(
            actor,
            value,
            functional=False,
            separate_losses=separate_losses,
            loss_critic_type="l2",
            entropy_coeff=0.0,
        )
        out = loss(data.clone())
        total = out["loss_objective"] + (0.0 if separate_losses else out["loss_critic"])
        gradients.append(torch.autograd.grad(total, list(trunk.parameters())))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


# -- calls ---------------------------------------------------------------------------------------------------------


def test_a_call_without_a_tensordict_gives_the_same_numbers():
    # TorchRL lists the next observation of the actor only: both read the same one here.
    actor, _ = networks()
    critic = ValueOperator(nn.Linear(ACTOR_DIM, 1), in_keys=["actor"])
    data = rollout(actor, num_envs=1, length=12)[0]
    loss = ClipPPOLoss(actor, critic)
    arguments = {key if isinstance(key, str) else "_".join(key): data[key] for key in loss.in_keys}
    expected = loss(data.select(*loss.in_keys))
    out = loss(**arguments)
    assert len(out) == len(loss.out_keys) > 5
    for name, value in zip(loss.out_keys, out, strict=True):
        torch.testing.assert_close(value, expected[name])
    loss.select_out_keys("loss_objective", "loss_critic")
    objective, critic_loss = loss(**arguments)
    assert (objective, critic_loss) == (expected["loss_objective"], expected["loss_critic"])


def test_the_data_stays_as_it_is():
    actor, critic = networks()
    data = minibatch(actor, critic)
    before = data.clone()
    ClipPPOLoss(actor, critic, normalize_advantage=True, clip_value=0.2)(data)
    assert set(data.keys(True, True)) == set(before.keys(True, True))
    assert (data == before).all()


def test_the_exploration_type_around_the_call_does_not_matter():
    actor, critic = networks()
    data = minibatch(actor, critic)
    loss = ClipPPOLoss(actor, critic)
    expected = loss(data.clone())
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC, ExplorationType.MEAN):
        with set_exploration_type(kind):
            out = loss(data.clone())
        for name in (*LOSSES, "kl"):
            torch.testing.assert_close(out[name], expected[name])


@pytest.mark.parametrize("reduction", [None, "none", "mean", "sum"])
def test_reductions_have_their_shapes_and_agree_with_stock(reduction):
    actor, critic = networks()
    data = GAE(gamma=0.9, lmbda=0.9, critic=critic)(rollout(actor))
    out, _ = same(*both(actor, critic, reduction=reduction, loss_critic_type="l2"), data)
    for name in LOSSES:
        assert out[name].shape == (data.shape if reduction == "none" else ())


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_masked_env_states_are_left_out_as_in_stock(reduction):
    actor, critic = networks()
    data = minibatch(actor, critic)
    data["collector", "mask"] = torch.rand(64, 1) < 0.7
    same(*both(actor, critic, reduction=reduction, clip_value=0.2), data)


def test_rows_that_are_left_out_may_be_anything():
    """Rows that pad a minibatch carry no policy's actions: their probability ratio overflows."""
    actor, critic = networks()
    loss, data = (
        ClipPPOLoss(actor, critic, clip_value=0.2, normalize_advantage=True),
        minibatch(actor, critic),
    )
    mask = torch.rand(64, 1) < 0.7
    spoilt = data.clone()
    for key, filler in (("action_log_prob", -1e3), ("advantage", 1e30), ("value_target", 1e30)):
        left_out = ~mask.reshape(data[key].shape)
        spoilt[key] = data[key].masked_fill(left_out, filler)
    kept, spoilt["collector", "mask"] = data[mask.squeeze(-1)], mask
    gradients = []
    for batch in (kept, spoilt):
        loss.zero_grad()
        out = loss(batch)
        sum(out[name] for name in LOSSES).backward()
        gradients.append(
            [out[name] for name in LOSSES] + [parameter.grad for parameter in loss.parameters()]
        )
    torch.testing.assert_close(gradients[1], gradients[0])


def test_a_minibatch_in_which_no_row_counts_has_losses_and_gradients_of_zero():
    actor, critic = networks()
    loss, data = ClipPPOLoss(actor, critic, normalize_advantage=True), minibatch(actor, critic)
    data["collector", "mask"] = torch.zeros(64, 1, dtype=torch.bool)
    data["action_log_prob"] -= 1e3
    out = loss(data)
    sum(out[name] for name in LOSSES).backward()
    assert all(out[name] == 0.0 for name in LOSSES)
    assert all(parameter.grad.abs().max() == 0.0 for parameter in loss.parameters())


@pytest.mark.parametrize("kind", list(ValueEstimators))
def test_each_of_torchrls_value_estimators_may_make_the_advantage(kind):
    actor, critic = networks()
    data = rollout(actor)
    losses = both(actor, critic, loss_critic_type="l2")
    for loss in losses:
        loss.make_value_estimator(kind, gamma=0.9)
    seeds = []
    for loss in losses:
        torch.manual_seed(3)  # TorchRL's V-trace draws actions
        seeds.append(loss(data.clone()))
    for name in LOSSES:
        torch.testing.assert_close(seeds[0][name], seeds[1][name], atol=1e-6, rtol=1e-6)
