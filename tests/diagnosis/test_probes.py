"""Probes see what losses do not, and leave networks, rollouts and generators as they were."""

import types

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded

from ksim_rl.diagnosis.probes import probed
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    RecurrentCfg,
    make_actor,
    make_critic,
    make_recurrent_actor,
)

E, T = 16, 8


def networks(**cfg):
    actor = make_actor(ActorCfg(hidden_dims=(8,), **cfg), obs_dim=3, action_dim=2)
    return actor, make_critic(CriticCfg(hidden_dims=(8,), **cfg), obs_dim=3)


def rollout(scale=1.0, **leaves):
    obs_ETL = scale * torch.randn(E, T, 3, generator=torch.Generator().manual_seed(0))
    return TensorDict({"actor": obs_ETL, "critic": obs_ETL.clone(), **leaves}, batch_size=[E, T])


def env(action_spec):
    return types.SimpleNamespace(full_action_spec=Composite({"action": action_spec}, shape=[E]))


def measured(actor, critic, rollout_ET, spec=None):
    update = types.SimpleNamespace(actor=actor, critic=critic)
    return probed(update, env(Unbounded((E, 2)) if spec is None else spec), rollout_ET)


@pytest.mark.parametrize("activation", ["elu", "relu", "tanh", "silu"])
def test_units_that_are_pushed_out_of_reach_are_dead(activation):
    actor, critic = networks(activation=activation)
    assert measured(actor, critic, rollout())["policy/dead_units"] == 0.0
    with torch.no_grad():
        for name, parameter in actor.named_parameters():
            if name.endswith("trunk.0.bias"):
                parameter[:4] = -1e3
    assert measured(actor, critic, rollout())["policy/dead_units"] == 4 / 16


def test_the_size_of_normalized_observations_is_one_where_statistics_fit():
    actor, critic = networks()
    for network in (actor, critic):
        for module in network.modules():
            if hasattr(module, "until"):
                module.update(rollout()["actor"])
    assert measured(actor, critic, rollout())["policy/observation_rms"] == pytest.approx(
        1.0, abs=1e-3
    )
    far = measured(actor, critic, rollout(scale=7.0))["policy/observation_rms"]
    assert far == pytest.approx(7.0, rel=0.1)


def test_recurrent_networks_are_not_probed():
    actor = make_recurrent_actor(
        RecurrentCfg(hidden_dim=4),
        ActorCfg(hidden_dims=(8,)),
        obs_dim=3,
        action_dim=2,
        action_spec=Unbounded((2,)),
    )
    assert measured(actor, networks()[1], rollout()) == {}


def test_what_an_update_lacks_is_left_out():
    actor, _ = networks()
    assert "policy/dead_units" in measured(actor, None, rollout())
    assert (
        measured(actor, None, rollout().select("critic")) == measured(None, None, rollout()) == {}
    )
    assert probed(None, env(Unbounded((E, 2))), None) == {}


def test_nothing_is_drawn_learned_or_written():
    actor, critic = networks()
    seen_ET, before = rollout(), torch.get_rng_state()
    state = {name: value.clone() for name, value in actor.state_dict().items()}
    measured(actor, critic, seen_ET)
    assert torch.equal(torch.get_rng_state(), before)
    assert set(seen_ET.keys()) == {"actor", "critic"}
    assert all(torch.equal(value, state[name]) for name, value in actor.state_dict().items())
    assert not any(module._forward_hooks for module in actor.modules())


def test_saturated_actions_are_those_on_their_bounds_or_beyond():
    action_ETL = torch.zeros(E, T, 2)
    action_ETL[0], action_ETL[1, 0] = 2.0, -1.0
    seen_ET = rollout(action=action_ETL)
    found = measured(None, None, seen_ET, Bounded(-1.0, 1.0, (E, 2)))
    assert found == {"rollout/saturated_actions": pytest.approx((T + 1) / (E * T))}
    endless = Bounded(torch.full((E, 2), -torch.inf), torch.full((E, 2), torch.inf), (E, 2))
    assert measured(None, None, seen_ET, endless) == {}
