"""Which networks a PPO update takes: mixed actions, shared trunks, several groups, and modules that are not ours."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, Composite
from torchrl.modules import (
    ActorValueOperator,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    SharedTrunkCfg,
    make_actor,
    make_critic,
    make_shared_trunk,
)
from ksim_rl.objectives import PPOCfg
from ksim_rl.testing import count_syncs
from ksim_rl.trainers import Evaluator, PPOUpdate
from ksim_rl.trainers.run_cfg import ModulesCfg
from ksim_rl.transforms import GaussianNoise, ObservationNoise
from tests.trainers.target_env import BEST_RETURN, LENGTH, TargetEnv, make_env

DATA = DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=4)
PPO = PPOCfg(num_epochs=4, learning_rate=1e-2, schedule="fixed", clip_value=False)


class MixedEnv(TargetEnv):
    """The action is an arm, which should go to the target x, and a grip, which should be 2 if x > 0 and else 0."""

    def __init__(self, num_envs=16):
        super().__init__(num_envs)
        shape = (num_envs,)
        parts = Composite(
            arm=Bounded(-2.0, 2.0, (num_envs, 1)), grip=Categorical(3, shape=shape), shape=shape
        )
        self.full_action_spec = Composite(action=parts, shape=shape)

    def _step(self, tensordict):
        right = tensordict["action", "grip"] == torch.where(self.target_E1[:, 0] > 0, 2, 0)
        # The wrong grip costs as much as an arm 1 beside the target.
        arm = torch.where(right[:, None], tensordict["action", "arm"], self.target_E1 + 1.0)
        return super()._step(tensordict.select("_reset", strict=False).set("action", arm))


def learn(env, actor, critic, *, iterations=8):
    """Return the update after training, without a host sync, and what it measured last."""
    update = PPOUpdate(PPO, actor=actor, critic=critic, data=DATA)
    collector = RolloutCollector(env, actor, rollout_length=16, keys=update.rollout_keys)
    update(collector.collect())
    rollout_ET = collector.collect()
    with count_syncs() as syncs:
        update(rollout_ET)
    assert syncs.total == 0, syncs.report()
    for _ in range(iterations - 2):
        update(collector.collect())
    metrics = {name: float(value) for name, value in update.metrics().items()}
    assert metrics["update/skipped_steps"] == 0 and metrics["update/non_finite_env_states"] == 0
    assert 0.0 < metrics["update/kl"] < 1.0
    return update, metrics


def evaluate(env, actor):
    return Evaluator(env, actor, max_steps=LENGTH, seed=7)().return_mean


def critic(**options):
    return make_critic(CriticCfg(hidden_dims=(16,), **options), obs_dim=1)


def test_mixed_actions_learn():
    torch.manual_seed(0)
    env = MaskedTransformedEnv(
        MixedEnv(), ObservationNoise(["actor"], noise=GaussianNoise(std=0.0))
    )
    cfg = ActorCfg(hidden_dims=(32,), distribution="tanh_gaussian", init_std=0.3)
    actor = make_actor(cfg, obs_dim=1, action_spec=env.full_action_spec)
    before = evaluate(env, actor)
    _, metrics = learn(env, actor, critic(), iterations=12)
    assert evaluate(env, actor) > max(before + 2.0, 0.75 * BEST_RETURN)
    assert 0.0 < metrics["policy/std"] < 2.0


@pytest.mark.full
def test_modules_that_are_not_ours_learn():
    torch.manual_seed(0)
    env = make_env()
    policy = nn.Sequential(nn.Linear(1, 32), nn.Tanh(), nn.Linear(32, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["actor"], out_keys=["mean", "spread"]),
        in_keys={"loc": "mean", "scale": "spread"},
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0},
        return_log_prob=True,
        default_interaction_type="random",
    )
    value = ValueOperator(
        nn.Sequential(nn.Linear(1, 16), nn.ELU(), nn.Linear(16, 1)), in_keys=["critic"]
    )
    before = evaluate(env, actor)
    update = PPOUpdate(
        PPOCfg(
            num_epochs=4, learning_rate=1e-2, schedule="adaptive", desired_kl=0.03, clip_value=False
        ),
        actor=actor,
        critic=value,
        data=DATA,
    )
    assert {"mean", "spread"} < set(update.rollout_keys) and "loc" not in update.rollout_keys
    collector = RolloutCollector(env, actor, rollout_length=16, keys=update.rollout_keys)
    for _ in range(10):
        update(collector.collect())
    metrics = update.metrics()
    assert 0.0 < metrics["update/kl"] < 1.0 and "policy/std" not in metrics
    assert evaluate(env, actor) > max(before + 1.0, 0.75 * BEST_RETURN)


def test_a_shared_trunk_learns_and_counts_observations_once():
    torch.manual_seed(0)
    env = make_env()
    trunk = make_shared_trunk(SharedTrunkCfg(hidden_dims=(32,)), obs_dim=1)
    own = {"hidden_dims": (), "obs_normalization": False}
    actor = make_actor(
        ActorCfg(**own, in_keys=("features",), init_std=0.5), obs_dim=32, action_dim=1
    )
    # The critic sees what it alone may see beside the features.
    value = make_critic(CriticCfg(**own, in_keys=("features", "critic")), obs_dim=33)
    both = ActorValueOperator(trunk, actor, value)
    update, _ = learn(env, both.get_policy_operator(), both.get_value_operator())
    assert "features" not in update.rollout_keys
    assert int(trunk.module.normalizer.count) == 8 * 256
    assert evaluate(env, update.actor) > 0.85 * BEST_RETURN


def test_groups_can_be_joined_and_nested():
    torch.manual_seed(0)
    env = make_env()
    actor = make_actor(
        ActorCfg(hidden_dims=(8,), in_keys=("critic", "actor")), obs_dim=2, action_dim=1
    )
    update, _ = learn(env, actor, critic(in_keys=("actor",)), iterations=2)
    assert {"actor", "critic", ("next", "actor")} < set(update.rollout_keys)
    assert ("next", "critic") not in update.rollout_keys


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"actor": ActorCfg(in_keys=("features",))},
            r"actor.in_keys=\('features',\): .*only with one",
        ),
        ({"trunk": SharedTrunkCfg()}, r"actor.in_keys=\('actor',\): .*modules=shared_trunk"),
        (
            {"trunk": SharedTrunkCfg(), "actor": ActorCfg(in_keys=("features",))},
            "actor.obs_normalization=True: with a trunk",
        ),
    ],
)
def test_networks_that_do_not_fit_together_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        ModulesCfg(**options)
