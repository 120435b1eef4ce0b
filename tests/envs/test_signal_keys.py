"""An env's own keys of reward and flags, and PPO and the collector on an env that nests them."""

from collections.abc import Mapping

import pytest
import torch
from torchrl.data import Composite, Unbounded
from torchrl.envs import SerialEnv
from torchrl.envs.utils import check_env_specs

from ksim_rl.algorithms.amp.update import AMPUpdate
from ksim_rl.algorithms.distillation.update import DistillationUpdate
from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.envs.signal_keys import SignalKeys, signal_keys
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import AMPCfg, DistillationCfg, PPOCfg
from ksim_rl.testing import CounterEnv
from tests.algorithms.imitation_problems import BINS, DriftEnv, PlaneEnv, circling, linear_teacher
from tests.algorithms.off_policy_problem import make_update
from tests.envs.nested_signals import NestedSignals, nested
from tests.trainers.target_env import TargetEnv

LENGTHS = (3, 5, 4)
NESTED = SignalKeys(*(("agent", name) for name in SignalKeys._fields))


def test_keys_are_the_envs_own_however_it_is_wrapped():
    check_env_specs(NestedSignals(LENGTHS))
    for wrap in (
        lambda env: env,
        MaskedTransformedEnv,
        lambda env: SerialEnv(2, lambda: CounterEnv(())),
    ):
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
        PPOCfg(num_epochs=2),
        actor=actor,
        critic=critic,
        data=data,
        seed=0,
        signals=signal_keys(env),
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


def off_policy(wrap, signals):
    env = wrap(TargetEnv)(16)
    return env, make_update("td3", env, num_steps=4, learning_starts=4, signals=signals)


def amp(wrap, signals):
    env = wrap(PlaneEnv)(16)
    actor = make_actor(ActorCfg(hidden_dims=(8,)), obs_dim=2, action_dim=2)
    critic = make_critic(CriticCfg(hidden_dims=(8,)), obs_dim=2)
    data = DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=2)
    cfg = AMPCfg(motions=("circle",), num_transitions_per_step=32, num_discriminator_steps=2)
    ppo = PPOUpdate(cfg, actor=actor, critic=critic, data=data, seed=0, signals=signals)
    return env, AMPUpdate(cfg, ppo=ppo, reference_N2L=circling(), num_envs=16)


def distillation(wrap, signals):
    env = wrap(DriftEnv)(16)
    student = make_actor(
        ActorCfg(hidden_dims=(), obs_normalization=False), obs_dim=len(BINS), action_dim=1
    )
    data = DatasetCfg(num_env_states_per_minibatch=48, num_minibatches=2)
    cfg = DistillationCfg(teacher="toy")
    return env, DistillationUpdate(
        cfg, actor=student, teacher=linear_teacher(), data=data, signals=signals
    )


@pytest.mark.parametrize("problem", [off_policy, amp, distillation])
def test_other_algorithms_learn_the_same_where_signals_are_nested(problem):
    """Two rollouts are one episode: TorchRL resets only what lies beside the flags, and the observations do not."""
    found = []
    for wrap, signals in ((lambda kind: kind, SignalKeys()), (nested, NESTED)):
        torch.manual_seed(0)
        env, update = problem(wrap, signals)
        assert signal_keys(env) == signals
        env.set_seed(0)
        length = update.num_env_states // 16
        before = {name: net.state_dict() for name, net in update.networks.items()}
        before = {
            name: {key: value.clone() for key, value in state.items()}
            for name, state in before.items()
        }
        collector = RolloutCollector(
            env, update.behavior, rollout_length=length, keys=update.rollout_keys
        )
        for ends in (False, True):
            rollout_ET = collector.collect()
            assert rollout_ET[signals.following[1]].any() == ends
            update(rollout_ET)
        after = {name: net.state_dict() for name, net in update.networks.items()}
        assert any(
            not torch.equal(before[name][key], value)
            for name in after
            for key, value in after[name].items()
        )
        found.append(update.state_dict())
    torch.testing.assert_close(*(flat(state) for state in found), rtol=0, atol=0)


def flat(state, name=""):
    if not isinstance(state, Mapping):
        return {name: state}
    return {
        key: value
        for part, inner in state.items()
        for key, value in flat(inner, f"{name}/{part}").items()
    }
