"""An env's own keys of reward and flags, and PPO and the collector on an env that nests them."""

import pytest
import torch
from torchrl.data import Composite, Unbounded
from torchrl.envs import SerialEnv
from torchrl.envs.utils import check_env_specs

from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.envs.signal_keys import SignalKeys, signal_keys
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg
from ksim_rl.testing import CounterEnv
from tests.envs.nested_signals import NestedSignals

LENGTHS = (3, 5, 4)
NESTED = SignalKeys(*(("agent", name) for name in SignalKeys._fields))


def test_keys_are_the_envs_own_however_it_is_wrapped():
    check_env_specs(NestedSignals(LENGTHS))
    for wrap in (lambda env: env, MaskedTransformedEnv, lambda env: SerialEnv(2, lambda: CounterEnv(()))):
        assert signal_keys(wrap(CounterEnv(LENGTHS))) == SignalKeys()
    assert (
        signal_keys(NestedSignals(LENGTHS))
        == signal_keys(MaskedTransformedEnv(NestedSignals(LENGTHS)))
        == NESTED
    )


def test_flags_that_an_env_lacks_and_rewards_it_has_too_many_of():
    env = CounterEnv(LENGTHS)
    spec = env.full_done_spec.clone()
    del spec["truncated"]
    env.full_done_spec = spec
    assert signal_keys(env) == SignalKeys(truncated=None)
    two = CounterEnv(LENGTHS)
    two.full_reward_spec = Composite(a=Unbounded((3, 1)), b=Unbounded((3, 1)), shape=(3,))
    with pytest.raises(ValueError, match=r"the rewards \['a', 'b'\]: expected one"):
        signal_keys(two)


def learned(env, observation):
    torch.manual_seed(0)
    observed = {"hidden_dims": (8,), "in_keys": (observation,)}
    actor = make_actor(ActorCfg(**observed), obs_dim=1, action_dim=2)
    critic = make_critic(CriticCfg(**observed), obs_dim=1)
    data = DatasetCfg(num_env_states_per_minibatch=12, num_minibatches=2)
    update = PPOUpdate(
        PPOCfg(num_epochs=2), actor=actor, critic=critic, data=data, seed=0, signals=signal_keys(env)
    )
    collector = RolloutCollector(env, actor, rollout_length=8, keys=update.rollout_keys)
    for _ in range(2):
        update(collector.collect())
    return update, collector.collect()


@pytest.mark.parametrize("wrap", [lambda env: env, MaskedTransformedEnv])
def test_ppo_learns_the_same_where_signals_are_nested(wrap):
    plain, _ = learned(wrap(CounterEnv(LENGTHS)), "count")
    nested, rollout_ET = learned(wrap(NestedSignals(LENGTHS)), ("agent", "count"))
    assert ("next", "agent", "reward") in rollout_ET.keys(True, True)
    assert "reward" not in rollout_ET["next"].keys()
    for one, other in zip(plain.actor.parameters(), nested.actor.parameters(), strict=True):
        assert torch.equal(one, other)
    assert plain.metrics()["loss/value"] == nested.metrics()["loss/value"] != 0.0
