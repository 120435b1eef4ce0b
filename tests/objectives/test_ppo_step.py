import dataclasses

import pytest
import torch
from tensordict import TensorDict
from torchrl import objectives

from ksim_rl.algorithms.gradient_steps import load_optimizer_state, optimizer_state
from ksim_rl.data import DatasetBuffer, DatasetCfg
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic, update_normalizers
from ksim_rl.objectives import (
    PPOCfg,
    StepGuard,
    make_advantage,
    make_loss,
    make_optimizer,
    ppo_step,
)
from ksim_rl.testing import count_syncs
from tests.objectives.problems import minibatch, networks, rollout


def _parts(cfg):
    actor, critic = networks()
    return actor, critic, make_loss(cfg, actor, critic), make_optimizer(cfg, actor, critic)


OTHER_THAN_DEFAULT = {
    "clip_epsilon": 0.1,
    "clip_value": 0.3,
    "entropy_coeff": 0.05,
    "critic_coeff": 0.7,
    "normalize_advantage": "minibatch",
    "betas": (0.8, 0.95),
    "adam_eps": 1e-5,
    "weight_decay": 0.02,
}


@pytest.mark.parametrize("fields", [{}, OTHER_THAN_DEFAULT], ids=["defaults", "others"])
def test_equals_a_step_written_with_stock_parts(fields):
    cfg = PPOCfg(schedule="fixed", max_grad_norm=0.5, learning_rate=3e-3, **fields)
    torch.manual_seed(1)
    actor, critic, loss, optimizer = _parts(cfg)
    torch.manual_seed(1)
    stock_actor, stock_critic, *_ = _parts(cfg)
    data = [minibatch(actor, critic, drift=0.0) for _ in range(3)]
    stock_loss = objectives.ClipPPOLoss(
        stock_actor,
        stock_critic,
        clip_epsilon=fields.get("clip_epsilon", 0.2),
        clip_value=fields.get("clip_value", 0.2),
        entropy_coeff=fields.get("entropy_coeff", 0.01),
        critic_coeff=fields.get("critic_coeff", 1.0),
        normalize_advantage=bool(fields),
        loss_critic_type="l2",
    )
    stock_optimizer = torch.optim.Adam(
        stock_loss.parameters(),
        lr=3e-3,
        betas=fields.get("betas", (0.9, 0.999)),
        eps=fields.get("adam_eps", 1e-8),
        weight_decay=fields.get("weight_decay", 0.0),
    )
    for minibatch_B in data:
        metrics = ppo_step(loss, optimizer, minibatch_B.clone(), cfg=cfg)
        out = stock_loss(minibatch_B.clone())
        stock_optimizer.zero_grad()
        (out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]).backward()
        norm = torch.nn.utils.clip_grad_norm_(stock_loss.parameters(), 0.5)
        stock_optimizer.step()
        torch.testing.assert_close(metrics["grad_norm"], norm, atol=1e-6, rtol=1e-5)
    for one, other in zip(
        (*actor.parameters(), *critic.parameters()),
        (*stock_actor.parameters(), *stock_critic.parameters()),
        strict=True,
    ):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


def test_metrics_are_detached_scalars_with_the_documented_names():
    cfg = PPOCfg()
    actor, critic, loss, optimizer = _parts(cfg)
    metrics = ppo_step(loss, optimizer, minibatch(actor, critic), cfg=cfg, guard=StepGuard())
    named = {
        "loss",
        "loss_objective",
        "loss_critic",
        "loss_entropy",
        "entropy",
        "kl",
        "clip_fraction",
    }
    assert (
        named | {"grad_norm", "learning_rate", "skipped", "value_clip_fraction"} <= metrics.keys()
    )
    for value in metrics.values():
        assert value.shape == ()
        assert not value.requires_grad


def test_bounds_and_thresholds_are_those_of_the_config():
    bounds = {"learning_rate_min": 8e-4, "learning_rate_max": 1.2e-3, "desired_kl": 0.01}
    for drift, expected in ((0.3, 8e-4), (1e-4, 1.2e-3)):
        cfg = PPOCfg(**bounds)
        actor, critic, loss, optimizer = _parts(cfg)
        metrics = ppo_step(loss, optimizer, minibatch(actor, critic, drift=drift), cfg=cfg)
        assert metrics["learning_rate"].item() == pytest.approx(expected, rel=1e-6)
    cfg = PPOCfg(advantage="vtrace", gamma=0.8, lmbda=0.6, rho_thresh=2.0, c_thresh=0.5)
    vtrace = make_advantage(cfg, actor, critic)
    constants = [vtrace.gamma, vtrace.lmbda, vtrace.rho_thresh, vtrace.c_thresh]
    torch.testing.assert_close(torch.stack(constants), torch.tensor([0.8, 0.6, 2.0, 0.5]))


@pytest.mark.parametrize(("drift", "factor"), [(0.3, 1 / 1.5), (1e-4, 1.5)])
def test_adaptive_schedule_changes_the_rate_in_place_and_fixed_does_not(drift, factor):
    for schedule, expected in (("adaptive", 1e-3 * factor), ("fixed", 1e-3)):
        cfg = PPOCfg(schedule=schedule)
        actor, critic, loss, optimizer = _parts(cfg)
        rate = optimizer.param_groups[0]["lr"]
        metrics = ppo_step(loss, optimizer, minibatch(actor, critic, drift=drift), cfg=cfg)
        assert optimizer.param_groups[0]["lr"] is rate
        assert rate.item() == pytest.approx(expected, rel=1e-6)
        assert metrics["learning_rate"].item() == pytest.approx(expected, rel=1e-6)


def test_a_step_that_is_not_finite_is_skipped_and_counted():
    cfg, guard = PPOCfg(), StepGuard()
    actor, critic, loss, optimizer = _parts(cfg)
    good = minibatch(actor, critic)
    ppo_step(loss, optimizer, good.clone(), cfg=cfg, guard=guard)
    rate = optimizer.param_groups[0]["lr"].item()
    before = [
        parameter.detach().clone() for parameter in (*actor.parameters(), *critic.parameters())
    ]
    bad = good.clone()
    bad["value_target"][3] = float("nan")
    bad["loc"][3] = float("nan")
    metrics = ppo_step(loss, optimizer, bad, cfg=cfg, guard=guard)
    assert metrics["skipped"].item() == 1.0
    for parameter, old in zip((*actor.parameters(), *critic.parameters()), before, strict=True):
        assert torch.equal(parameter, old)
    assert {state["step"].item() for state in optimizer.state.values()} == {1.0}
    assert optimizer.param_groups[0]["lr"].item() == rate
    assert (int(guard.skipped), int(guard.skipped_in_a_row)) == (1, 1)
    assert ppo_step(loss, optimizer, good.clone(), cfg=cfg, guard=guard)["skipped"].item() == 0.0
    assert (int(guard.skipped), int(guard.skipped_in_a_row)) == (1, 0)


def test_shared_parameters_are_optimized_once():
    cfg = PPOCfg()
    actor, critic, loss, _ = _parts(cfg)
    optimizer = make_optimizer(cfg, actor, critic, actor, loss)
    parameters = optimizer.param_groups[0]["params"]
    assert (
        len(parameters) == len(set(parameters)) == len({*actor.parameters(), *critic.parameters()})
    )


def test_a_learning_rate_that_is_given_anew_stays():
    cfg = PPOCfg()
    actor, critic, _, optimizer = _parts(cfg)
    optimizer.param_groups[0]["lr"].fill_(9e-3)
    resumed = make_optimizer(dataclasses.replace(cfg, learning_rate=2e-4), actor, critic)
    load_optimizer_state(resumed, optimizer_state(optimizer), what="optimizer")
    assert resumed.param_groups[0]["lr"].item() == pytest.approx(2e-4)


def test_optimizer_state_continues_exactly():
    cfg = PPOCfg()
    actor, critic, loss, optimizer = _parts(cfg)
    first, second = minibatch(actor, critic), minibatch(actor, critic)
    ppo_step(loss, optimizer, first, cfg=cfg)
    resumed = make_optimizer(cfg, actor, critic)
    rate = resumed.param_groups[0]["lr"].fill_(9e-3)
    load_optimizer_state(resumed, optimizer_state(optimizer), what="optimizer")
    assert resumed.param_groups[0]["lr"] is rate
    assert rate == optimizer.param_groups[0]["lr"]
    assert rate.data_ptr() != optimizer.param_groups[0]["lr"].data_ptr()
    state = {name: value.clone() for name, value in loss.state_dict().items()}
    ppo_step(loss, optimizer, second.clone(), cfg=cfg)
    expected = [parameter.detach().clone() for parameter in loss.parameters()]
    loss.load_state_dict(state)
    ppo_step(loss, resumed, second.clone(), cfg=cfg)
    for parameter, value in zip(loss.parameters(), expected, strict=True):
        assert torch.equal(parameter, value)


def _update(cfg, parts, dataset, data, guard):
    actor, critic, loss, optimizer, gae = parts
    dataset.extend(gae(data))
    for _ in range(cfg.num_epochs):
        for minibatch_B in dataset.epoch():
            metrics = ppo_step(loss, optimizer, minibatch_B, cfg=cfg, guard=guard)
    update_normalizers(data, actor, critic)
    return metrics


@pytest.mark.parametrize("normalize_advantage", ["dataset", "minibatch", "none"])
def test_a_whole_update_makes_no_host_sync(normalize_advantage):
    cfg = PPOCfg(num_epochs=2, normalize_advantage=normalize_advantage)
    actor, critic, loss, optimizer = _parts(cfg)
    sizes = DatasetCfg(num_env_states_per_minibatch=12, num_minibatches=4)
    dataset = DatasetBuffer(sizes, keys=loss.dataset_keys)
    parts = (actor, critic, loss, optimizer, make_advantage(cfg, actor, critic))
    data, guard = rollout(actor), StepGuard()
    with count_syncs() as syncs:
        _update(cfg, parts, dataset, data.clone(), guard)
    assert syncs.total == 0, syncs.report()
    data["next", "reward"][2, 3] = float("nan")
    metrics = _update(cfg, parts, dataset, data, guard)
    assert int(dataset.non_finite_count) == 1
    assert int(guard.skipped) == 0
    assert all(value.isfinite() for value in metrics.values())


def test_learns_an_action_that_depends_on_the_state():
    # One-step episodes with reward -|a - target(s)|^2: the best policy and its value are known.
    cfg = PPOCfg(learning_rate=1e-2, entropy_coeff=0.0, desired_kl=0.02, num_epochs=3)
    actor = make_actor(ActorCfg(hidden_dims=(32,), init_std=0.5), obs_dim=1, action_dim=1)
    critic = make_critic(CriticCfg(hidden_dims=(32,)), obs_dim=1)
    loss, optimizer = make_loss(cfg, actor, critic), make_optimizer(cfg, actor, critic)
    dataset = DatasetBuffer(
        DatasetCfg(num_env_states_per_minibatch=256, num_minibatches=2), keys=loss.dataset_keys
    )
    parts, guard = (actor, critic, loss, optimizer, make_advantage(cfg, actor, critic)), StepGuard()

    def collect():
        obs = torch.randint(0, 2, (256, 2, 1)) * 2.0 - 1.0
        data = TensorDict({"actor": obs, "critic": obs}, [256, 2])
        with torch.no_grad():
            actor(data)
        done = torch.ones(256, 2, 1, dtype=torch.bool)
        reward = -(data["action"] - 0.7 * obs).square()
        flags = {"done": done, "terminated": done, "truncated": ~done}
        data["next"] = TensorDict({"critic": obs, "reward": reward, **flags}, [256, 2])
        return data

    first = collect()["next", "reward"].mean()
    for _ in range(30):
        _update(cfg, parts, dataset, collect(), guard)
    probe = TensorDict(
        {"actor": torch.tensor([[-1.0], [1.0]]), "critic": torch.tensor([[-1.0], [1.0]])}, [2]
    )
    torch.testing.assert_close(
        actor(probe)["loc"].flatten(), torch.tensor([-0.7, 0.7]), atol=0.15, rtol=0.0
    )
    last = collect()["next", "reward"].mean()
    assert last > 0.2 * first
    assert critic(probe)["state_value"].mean().item() == pytest.approx(last.item(), abs=0.1)
