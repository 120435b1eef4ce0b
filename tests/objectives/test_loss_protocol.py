"""What TorchRL's `LossModuleTestBase` and the tests of its losses ask, asked of SAC's, TD3's and distillation's losses.

`test_loss_module.py` asks it of `ClipPPOLoss`.
"""

import copy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule

from ksim_rl import objectives
from ksim_rl.data import MASK_KEY
from ksim_rl.modules import (
    DeterministicActorCfg,
    QNetworkCfg,
    SquashedActorCfg,
    make_deterministic_actor,
    make_q_network,
    make_squashed_actor,
)
from ksim_rl.objectives import ClipPPOLoss, DistillationLoss, OffPolicyLoss, SACLoss, TD3Loss
from tests.objectives.problems import networks

BATCH, OBS, ACTION = 32, 5, 3
KEYS = {
    "action": "action",
    "reward": "reward",
    "terminated": "terminated",
    "steps_to_next_obs": "steps_to_next_obs",
    "priority": "td_error",
    "priority_weight": "priority_weight",
}


def off_policy(kind, *, atoms=1, layer_norm=False, seed=0):
    torch.manual_seed(seed)
    plain = {"hidden_dims": (16, 16), "obs_normalization": False}
    spec = Bounded(-1.0, 1.0, (ACTION,))
    cfg = QNetworkCfg(num_atoms=atoms, layer_norm=layer_norm, **plain)
    critic = make_q_network(cfg, obs_dim=OBS, action_dim=ACTION)
    options = {"support_A": critic.module.support}
    if kind is SACLoss:
        options |= {"target_entropy": -3.0, "alpha_init": 0.3}
        actor = make_squashed_actor(SquashedActorCfg(**plain), obs_dim=OBS, action_spec=spec)
    else:
        options |= {"low_L": torch.full((ACTION,), -1.0), "high_L": torch.ones(ACTION)}
        actor = make_deterministic_actor(
            DeterministicActorCfg(**plain), obs_dim=OBS, action_spec=spec
        )
    return kind(actor, critic, **options)


LOSSES = {
    "SAC": partial(off_policy, SACLoss),
    "SAC of distributions": partial(off_policy, SACLoss, atoms=7, layer_norm=True),
    "TD3": partial(off_policy, TD3Loss),
    "TD3 of distributions": partial(off_policy, TD3Loss, atoms=7),
}
each_loss = pytest.mark.parametrize("make", LOSSES.values(), ids=LOSSES)


def minibatch():
    torch.manual_seed(1)
    data = {("next", name): torch.randn(BATCH, OBS) for name in ("actor", "critic")}
    data |= {name: torch.randn(BATCH, OBS) for name in ("actor", "critic")}
    data |= {"action": torch.rand(BATCH, ACTION) * 2 - 1, ("next", "reward"): torch.randn(BATCH, 1)}
    data["next", "terminated"] = torch.rand(BATCH, 1) < 0.3
    return TensorDict(data, [BATCH])


def evaluated(loss, data):
    torch.manual_seed(2)
    return loss(data)


def test_no_loss_is_left_out():
    public = {value for value in vars(objectives).values() if isinstance(value, type)}
    # The base of two, and behavior cloning, which `tests/algorithms/test_bc_update.py` compares with TorchRL's.
    others = {OffPolicyLoss, objectives.BCLoss, objectives.BCAndValueLoss}
    losses = {cls for cls in public if issubclass(cls, LossModule)} - others
    assert losses == {type(make()) for make in LOSSES.values()} | {ClipPPOLoss}


@each_loss
def test_keys_have_their_defaults_can_be_set_and_unknown_ones_are_refused(make):
    loss = make()
    assert {name: getattr(loss.tensor_keys, name) for name in KEYS} == KEYS
    for name, default in KEYS.items():
        loss.set_keys(**{name: ("other", "key")})
        assert getattr(loss.tensor_keys, name) == ("other", "key")
        loss.set_keys(**{name: None})
        assert getattr(loss.tensor_keys, name) == default
    loss.set_keys(**dict.fromkeys(KEYS, "test1"))
    assert all(getattr(loss.tensor_keys, name) == "test1" for name in KEYS)
    with pytest.raises(ValueError, match="unknown_key"):
        loss.set_keys(unknown_key="test2")


@each_loss
def test_all_keys_of_the_data_may_have_other_names_nested_ones_too(make):
    loss, data = make(), minibatch()
    data["priority_weight"], data["steps_to_next_obs"] = (
        torch.rand(BATCH, 1),
        torch.randint(1, 4, (BATCH, 1)),
    )
    expected = evaluated(loss, data)
    other = make()
    other.set_keys(**{name: ("agent", key) for name, key in KEYS.items() if name != "action"})
    moved = data.exclude("td_error")
    for name in ("priority_weight", "steps_to_next_obs"):
        moved["agent", name] = moved.pop(name)
    for name in ("reward", "terminated"):
        moved["next", "agent", name] = moved["next"].pop(name)
    out = evaluated(other, moved)
    for name in expected.keys():
        torch.testing.assert_close(out[name], expected[name])
    assert torch.equal(moved["agent", "td_error"], data["td_error"])


@each_loss
def test_resetting_parameters_changes_them_all(make):
    loss = make()
    learned = {
        name: parameter
        for name, parameter in loss.named_parameters()
        if name.startswith(("actor_network", "critic_network"))
    }
    assert len(learned) >= 12
    with torch.no_grad():
        for parameter in learned.values():
            parameter.add_(1000.0)
    before = {name: parameter.clone() for name, parameter in learned.items()}
    loss.reset_parameters_recursive()
    assert all((before[name] != parameter).any() for name, parameter in learned.items())
    assert all(
        parameter.isfinite().all() and parameter.abs().max() < 100.0
        for parameter in learned.values()
    )


@each_loss
def test_each_loss_trains_its_own_network_and_all_of_it(make):
    loss = make()
    out = evaluated(loss, minibatch())
    trained = {
        "loss_qvalue": "critic_network",
        "loss_actor": "actor_network",
        "loss_alpha": "log_alpha",
    }
    seen = set()
    for name in [key for key in out.keys() if key.startswith("loss_")]:
        loss.zero_grad()
        out[name].backward(retain_graph=True)
        for key, parameter in loss.named_parameters():
            if key.startswith(trained[name]):
                seen.add(key)
                assert parameter.grad is not None and parameter.grad.norm() > 0, (name, key)
            else:
                assert parameter.grad is None or parameter.grad.norm() == 0, (name, key)
    assert seen == {key for key, parameter in loss.named_parameters() if parameter.requires_grad}
    assert all(not out[key].requires_grad for key in out.keys() if not key.startswith("loss_"))


@each_loss
def test_gradients_are_the_slopes_of_the_losses(make):
    """By central differences in float64: of the critics' loss in a critic's weights, of the actor's in an actor's."""
    loss = make().double()
    data = minibatch().apply(lambda leaf: leaf if leaf.dtype == torch.bool else leaf.double())
    for name, network in (("loss_qvalue", loss.critic_network), ("loss_actor", loss.actor_network)):
        (weight, *_) = [parameter for parameter in network.parameters() if parameter.ndim > 1]
        (slope,) = torch.autograd.grad(evaluated(loss, data.clone())[name], weight)
        direction = torch.randn_like(weight)
        with torch.no_grad():
            ends = []
            for step in (1e-6, -1e-6):
                weight.add_(step * direction)
                ends.append(evaluated(loss, data.clone())[name].item())
                weight.sub_(step * direction)
        expected = (ends[0] - ends[1]) / 2e-6
        assert (slope * direction).sum().item() == pytest.approx(expected, rel=2e-3, abs=1e-6), name


@each_loss
def test_a_state_dict_restores_the_loss_targets_included(make):
    loss, other, data = make(), make(seed=3), minibatch()
    with torch.no_grad():
        for parameter in loss.target_critic_network.parameters():
            parameter.add_(0.1)
    expected = evaluated(loss, data.clone())
    assert not torch.allclose(
        evaluated(other, data.clone())["loss_qvalue"], expected["loss_qvalue"]
    )
    other.load_state_dict(loss.state_dict())
    for name, value in evaluated(other, data.clone()).items():
        torch.testing.assert_close(value, expected[name])
    for name, value in evaluated(copy.deepcopy(loss), data.clone()).items():
        torch.testing.assert_close(value, expected[name])


@each_loss
def test_a_call_without_a_tensordict_gives_the_same_numbers(make):
    loss, data = make(), minibatch()
    expected = evaluated(loss, data.clone())
    arguments = {key if isinstance(key, str) else "_".join(key): data[key] for key in loss.in_keys}
    torch.manual_seed(2)
    out = loss(**arguments)
    assert len(out) == len(loss.out_keys) == len(expected.keys())
    for name, value in zip(loss.out_keys, out, strict=True):
        torch.testing.assert_close(value, expected[name])
    loss.select_out_keys("loss_actor", "loss_qvalue")
    torch.manual_seed(2)
    assert loss(**arguments) == (expected["loss_actor"], expected["loss_qvalue"])


@each_loss
def test_the_data_stays_as_it_is_but_for_the_priority(make):
    data = minibatch()
    before = data.clone()
    evaluated(make(), data)
    assert set(data.keys(True, True)) == {*before.keys(True, True), "td_error"}
    assert (data.exclude("td_error") == before).all()
    assert data["td_error"].shape == (BATCH,) and not data["td_error"].requires_grad


@each_loss
def test_the_exploration_type_around_the_call_does_not_matter(make):
    loss = make()
    expected = evaluated(loss, minibatch())
    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC, ExplorationType.MEAN):
        with set_exploration_type(kind):
            out = evaluated(loss, minibatch())
        for name in expected.keys():
            torch.testing.assert_close(out[name], expected[name])


@each_loss
def test_a_minibatch_in_which_no_row_counts_has_losses_and_gradients_of_zero(make):
    loss, data = make(), minibatch()
    data[MASK_KEY] = torch.zeros(BATCH, 1, dtype=torch.bool)
    out = evaluated(loss, data)
    for name in ("loss_qvalue", "loss_actor"):
        assert out[name] == 0.0
        out[name].backward(retain_graph=True)
    networks_of = (loss.actor_network, loss.critic_network)
    assert all(
        parameter.grad.abs().max() == 0.0 for net in networks_of for parameter in net.parameters()
    )


@each_loss
@pytest.mark.parametrize("filler", [0.0, 1e15])
def test_rows_that_are_left_out_may_be_anything(make, filler):
    """Rows of zeros pad a minibatch, and those whose physics broke may hold any number."""
    loss, data, mask = make(), minibatch(), torch.rand(BATCH) < 0.7
    spoilt = data.apply(
        lambda leaf: (
            leaf
            if leaf.dtype == torch.bool
            else leaf.masked_fill(~mask.view(-1, *[1] * (leaf.ndim - 1)), filler)
        )
    )
    spoilt[MASK_KEY] = mask[:, None]
    found = []
    for batch in (data.set(MASK_KEY, mask[:, None]), spoilt):
        loss.zero_grad()
        out = evaluated(loss, batch)
        sum(out[name] for name in out.keys() if name.startswith("loss_")).backward()
        found.append(
            [out[name] for name in out.keys()]
            + [p.grad for p in loss.parameters() if p.requires_grad]
        )
    torch.testing.assert_close(found[1], found[0])


@each_loss
def test_moves_to_another_dtype(make):
    loss, data = make(), minibatch()
    expected = evaluated(loss, data.clone())["loss_qvalue"]
    data = data.apply(lambda leaf: leaf if leaf.dtype == torch.bool else leaf.double())
    out = loss.double()(data)
    assert (
        out["loss_qvalue"].dtype == torch.float64
        and out["loss_qvalue"].isfinite()
        and expected.isfinite()
    )


@pytest.mark.parametrize("kind", ["kl", "mse"])
def test_distillation_trains_the_student_alone_leaves_the_data_and_ignores_exploration(kind):
    student, _ = networks()
    teacher, _ = networks()
    loss = DistillationLoss(student, teacher, loss=kind)
    data = TensorDict({"actor": torch.randn(6, 4, 5)}, [6, 4])
    with torch.no_grad():
        student(data)
    data = loss.label(data)
    before = data.clone()
    expected = loss(data)
    assert set(data.keys(True, True)) == set(before.keys(True, True)) and (data == before).all()
    expected["loss_distillation"].backward()
    grads = [parameter.grad for parameter in student[0].module.trunk.parameters()]
    assert all(grad is not None and grad.norm() > 0 for grad in grads)
    assert all(parameter.grad is None for parameter in teacher.parameters())
    assert set(loss.state_dict()) == {f"actor_network.{name}" for name in student.state_dict()}
    for explored in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        with set_exploration_type(explored):
            assert loss(data)["loss_distillation"] == expected["loss_distillation"]
    student.zero_grad()
    data[MASK_KEY] = torch.zeros(6, 4, 1, dtype=torch.bool)
    data["actor"].fill_(1e30)
    out = loss(data)
    out["loss_distillation"].backward()
    assert out["loss_distillation"] == out["kl"] == 0.0
    assert all(
        parameter.grad.abs().max() == 0.0 for parameter in student[0].module.trunk.parameters()
    )
    assert not any(isinstance(module, nn.Dropout) for module in loss.modules())
