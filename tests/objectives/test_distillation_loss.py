"""The distances between student and teacher against torch's own."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import distributions, nn
from torchrl.data import Bounded, Categorical, Composite

from ksim_rl.modules import ActorCfg, make_actor
from ksim_rl.objectives import DistillationCfg, DistillationLoss
from ksim_rl.testing import count_syncs

A = 2


def networks(distribution="gaussian", **options):
    torch.manual_seed(0)
    cfg = ActorCfg(hidden_dims=(8,), distribution=distribution, output_gain=1.0, **options)
    teacher = make_actor(
        ActorCfg(
            in_keys=("privileged",),
            hidden_dims=(8,),
            distribution=distribution,
            init_std=0.4,
            output_gain=1.0,
            **options,
        ),
        obs_dim=5,
        action_dim=A,
    )
    return make_actor(cfg, obs_dim=3, action_dim=A), teacher.requires_grad_(False)


def rollout(actor, shape=(4, 6)):
    data = TensorDict(
        {"actor": torch.randn(*shape, 3), "privileged": torch.randn(*shape, 5)}, shape
    )
    with torch.no_grad():
        return actor(data)


def gaussian(network, td):
    loc, scale = network(td.clone()).get("loc"), network(td.clone()).get("scale")
    return distributions.Independent(distributions.Normal(loc, scale), 1)


@pytest.mark.parametrize("kind", ["mse", "kl"])
def test_losses_and_gradients_are_those_of_torch(kind):
    actor, teacher = networks()
    loss = DistillationLoss(actor, teacher, loss=kind)
    data = rollout(actor)
    out = loss(loss.label(data).select(*loss.dataset_keys).reshape(-1))
    student, shown = gaussian(actor[0], data), gaussian(teacher[0], data)
    expected = (
        (student.mean - shown.mean).square().mean()
        if kind == "mse"
        else distributions.kl_divergence(shown, student).mean()
    )
    torch.testing.assert_close(out["loss_distillation"], expected)
    assert out["kl"] == 0.0, "the student has not moved since it collected"
    parameters = list(actor.parameters())
    for one, other in zip(
        torch.autograd.grad(out["loss_distillation"], parameters, allow_unused=True),
        torch.autograd.grad(expected, parameters, allow_unused=True),
        strict=True,
    ):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other)
    error = loss.action_error(loss.label(data))
    torch.testing.assert_close(error, (student.mean - shown.mean).square().mean().sqrt().detach())


def test_masked_env_states_are_left_out_and_how_far_the_student_moved_is_its_divergence():
    actor, teacher = networks()
    loss = DistillationLoss(actor, teacher)
    data = loss.label(rollout(actor, (16,)))
    before = gaussian(actor[0], data)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1)
    mask = torch.rand(16, 1) < 0.6
    data["collector", "mask"] = mask
    out, kept = loss(data), loss(data[mask[:, 0]])
    torch.testing.assert_close(out["loss_distillation"], kept["loss_distillation"])
    moved = distributions.kl_divergence(before, gaussian(actor[0], data))[mask[:, 0]].mean()
    torch.testing.assert_close(out["kl"], moved.detach())


def test_bounded_actions_are_compared_within_their_bounds():
    actor, teacher = networks("tanh_gaussian", action_bound=2.0)
    loss = DistillationLoss(actor, teacher, loss="mse")
    data = rollout(actor, (16,))
    out = loss(loss.label(data))
    means = [2.0 * torch.tanh(network[0](data.clone())["loc"]) for network in (actor, teacher)]
    torch.testing.assert_close(out["loss_distillation"], (means[0] - means[1]).square().mean())


def test_choices_are_compared_by_their_divergence():
    spec = Categorical(4)
    cfg = {"hidden_dims": (8,), "distribution": "categorical", "output_gain": 1.0}
    actor = make_actor(ActorCfg(**cfg), obs_dim=3, action_spec=spec)
    teacher = make_actor(ActorCfg(in_keys=("privileged",), **cfg), obs_dim=5, action_spec=spec)
    loss = DistillationLoss(actor, teacher, loss="kl")
    data = rollout(actor, (16,))
    logits = [network[0](data.clone())["logits"].log_softmax(-1) for network in (teacher, actor)]
    expected = (logits[0].exp() * (logits[0] - logits[1])).sum(-1).mean()
    torch.testing.assert_close(loss(loss.label(data))["loss_distillation"], expected)
    with pytest.raises(ValueError, match="choices, which have no distance; use loss='kl'"):
        DistillationLoss(actor, teacher, loss="mse")


def test_parts_of_an_action_are_compared_side_by_side():
    box = Bounded(-2.0, 1.0, (2,))
    cfg = {"hidden_dims": (8,), "distribution": "tanh_gaussian", "output_gain": 1.0}

    def both(**parts):
        spec = Composite(action=Composite(parts))
        return (
            make_actor(ActorCfg(**cfg), obs_dim=3, action_spec=spec),
            make_actor(ActorCfg(in_keys=("privileged",), **cfg), obs_dim=5, action_spec=spec),
        )

    actor, teacher = both(arm=box, leg=Bounded(-1.0, 3.0, (3,)))
    data = rollout(actor)
    with torch.no_grad():
        errors = [
            actor.get_dist(data.clone()).dists["action", part].median
            - teacher.get_dist(data.clone()).dists["action", part].median
            for part in ("arm", "leg")
        ]
    squares = torch.cat(errors, -1).square()
    loss = DistillationLoss(actor, teacher, loss="mse")
    labelled = loss.label(data)
    out = loss(labelled.select(*loss.dataset_keys).reshape(-1))
    torch.testing.assert_close(out["loss_distillation"].detach(), squares.mean())
    torch.testing.assert_close(loss.action_error(labelled), squares.mean().sqrt())
    mixed = both(arm=box, grip=Categorical(3))
    with pytest.raises(ValueError, match="choices, which have no distance; use loss='kl'"):
        DistillationLoss(*mixed, loss="mse")
    assert DistillationLoss(*mixed).action_error(labelled) == 0.0


def test_a_teacher_without_a_distribution_has_no_divergence():
    actor, _ = networks()
    teacher = TensorDictModule(nn.Linear(5, A), in_keys=["privileged"], out_keys=["action"])
    with pytest.raises(ValueError, match="no distribution; use loss='mse'"):
        DistillationLoss(actor, teacher)
    loss = DistillationLoss(actor, teacher, loss="mse")
    assert loss(loss.label(rollout(actor)).reshape(-1))["loss_distillation"] > 0.0
    other = make_actor(
        ActorCfg(
            in_keys=("privileged",), hidden_dims=(), distribution="tanh_gaussian", action_bound=1.0
        ),
        obs_dim=5,
        action_dim=A,
    )
    loss = DistillationLoss(actor, other)
    with pytest.raises(ValueError, match="distributions of different kinds; use loss='mse'"):
        loss(loss.label(rollout(actor)).reshape(-1))


def test_nothing_waits_for_the_device_and_the_teacher_does_not_learn():
    actor, teacher = networks()
    loss = DistillationLoss(actor, teacher)
    data = rollout(actor)
    with count_syncs() as syncs:
        labelled = loss.label(data)
        loss.action_error(labelled)
        loss(labelled.reshape(-1))["loss_distillation"].backward()
    assert syncs.total == 0, syncs.report()
    assert "teacher" not in data, "the rollout stays as it is"
    assert set(loss.parameters()) == set(actor.parameters())


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"teacher": ""}, "teacher='': name a run folder or a checkpoint"),
        ({"loss": "huber"}, "loss='huber'"),
        ({"num_epochs": 0}, "num_epochs=0: expected a whole number >= 1"),
        ({"teacher_share": 1.5}, r"teacher_share=1.5: expected a finite number in \[0.0, 1.0\]"),
        ({"teacher_share_decay": -0.1}, "teacher_share_decay"),
        ({"learning_rate": 0.0}, "learning_rate=0.0"),
        ({"max_grad_norm": 0.0}, "max_grad_norm"),
        ({"betas": (0.9, 1.0)}, "betas"),
        ({"learning_rate_min": 1.0}, "exceeds learning_rate_max"),
        ({"learning_rate": 0.05, "schedule": "adaptive"}, "learning_rate=0.05"),
    ],
)
def test_values_out_of_range_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        DistillationCfg(**{"teacher": "runs/teacher", **fields})
