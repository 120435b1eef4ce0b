"""Policies whose actions lie in a box, and how they explore it."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.modules import (
    DeterministicActorCfg,
    ExploringPolicy,
    SquashedActorCfg,
    make_deterministic_actor,
    make_squashed_actor,
)
from ksim_rl.modules.action_heads import action_range

LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 5.0])


def test_bounds_are_those_of_the_spec_where_it_has_any():
    for spec in (Bounded(LOW, HIGH, (2,)), Bounded(LOW.expand(7, 2), HIGH.expand(7, 2), (7, 2))):
        low, high = action_range(spec, 3.0)
        assert torch.equal(low, LOW) and torch.equal(high, HIGH)
    low, high = action_range(Unbounded((7, 2)), 3.0)
    assert low.tolist() == [-3.0, -3.0] and high.tolist() == [3.0, 3.0]


@pytest.mark.parametrize("layer_norm", [False, True])
def test_actions_fill_the_box_and_stay_in_it(layer_norm):
    torch.manual_seed(0)
    sizes = {"obs_dim": 4, "action_spec": Bounded(LOW, HIGH, (2,))}
    deterministic = make_deterministic_actor(
        DeterministicActorCfg(hidden_dims=(16,), output_gain=3.0, layer_norm=layer_norm), **sizes
    )
    squashed = make_squashed_actor(
        SquashedActorCfg(hidden_dims=(16,), output_gain=3.0, layer_norm=layer_norm), **sizes
    )
    for actor in (deterministic, squashed):
        with set_exploration_type(ExplorationType.RANDOM):
            action = actor(TensorDict({"actor": 3 * torch.randn(4000, 4)}, [4000]))["action"]
        assert (action >= LOW).all() and (action <= HIGH).all()
        assert (action.amax(0) > LOW + 0.95 * (HIGH - LOW)).all()
        assert (action.amin(0) < LOW + 0.05 * (HIGH - LOW)).all()


def test_the_first_policy_acts_in_the_middle_and_the_std_keeps_its_bounds():
    cfg = SquashedActorCfg(hidden_dims=(16,), output_gain=0.0, log_std_min=-4.0, log_std_max=0.0)
    actor = make_squashed_actor(cfg, obs_dim=4, action_spec=Bounded(LOW, HIGH, (2,)))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        out = actor(TensorDict({"actor": torch.randn(5, 4)}, [5]))
    torch.testing.assert_close(out["action"], ((LOW + HIGH) / 2).expand(5, 2))
    torch.testing.assert_close(out["scale"].log(), torch.full((5, 2), -2.0))
    actor[0].module.layers[-1].bias.data.fill_(1e4)
    assert (actor(TensorDict({"actor": torch.randn(5, 4)}, [5]))["scale"].log() <= 1e-6).all()


def test_exploration_is_uniform_first_and_then_has_the_noise_of_each_env():
    torch.manual_seed(0)
    actor = make_deterministic_actor(
        DeterministicActorCfg(hidden_dims=(8,), output_gain=0.0),
        obs_dim=4,
        action_spec=Bounded(LOW, HIGH, (2,)),
    )
    policy = ExploringPolicy(
        actor, low_L=LOW, high_L=HIGH, num_envs=6, noise_min=0.05, noise_max=0.3
    )
    obs = torch.randn(6, 4)

    def actions():
        return torch.stack([policy(TensorDict({"actor": obs}, [6]))["action"] for _ in range(2000)])

    uniform = actions().flatten(0, 1)
    torch.testing.assert_close(uniform.std(0), (HIGH - LOW) / 12**0.5, rtol=0.03, atol=0.0)
    policy.random.fill_(False)
    spread = actions().std(0) / ((HIGH - LOW) / 2)
    torch.testing.assert_close(spread, policy.noise_scale_E1.expand(6, 2), rtol=0.08, atol=0.0)
    before = policy.noise_scale_E1.clone()
    policy.end_episodes_(torch.tensor([True, False, False, True, False, False]))
    assert (policy.noise_scale_E1 != before)[:, 0].tolist() == [
        True,
        False,
        False,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("kind", [DeterministicActorCfg, SquashedActorCfg])
def test_what_they_refuse(kind):
    with pytest.raises(ValueError, match="action_bound"):
        kind(action_bound=0.0)
    with pytest.raises(ValueError, match="log_std_min"):
        SquashedActorCfg(log_std_min=1.0, log_std_max=1.0)


def test_bounds_move_with_the_policy():
    sizes = {"obs_dim": 4, "action_spec": Bounded(LOW, HIGH, (2,))}
    actor = make_squashed_actor(SquashedActorCfg(hidden_dims=(16,)), **sizes).to("meta")
    action = actor(TensorDict({"actor": torch.randn(5, 4, device="meta")}, [5]))["action"]
    assert action.device.type == "meta"
