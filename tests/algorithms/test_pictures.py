"""Policies that see: a target that only pictures show is learned by each kind of algorithm on torch's path."""

import pytest
import torch
from torchrl.data import Unbounded

from ksim_rl.algorithms.distillation.teacher import Teacher
from ksim_rl.algorithms.distillation.update import DistillationUpdate
from ksim_rl.algorithms.ppo.fused import fused_networks
from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    EncoderCfg,
    RecurrentCfg,
    make_actor,
    make_critic,
    make_for_spec,
    make_recurrent_actor,
    recurrent_modules,
    recurrent_transforms,
)
from ksim_rl.objectives import DistillationCfg, PPOCfg, make_loss
from ksim_rl.testing import check_env, count_syncs
from ksim_rl.trainers import Evaluator, PPOUpdate
from tests.algorithms.off_policy_problem import make_update
from tests.trainers.target_env import BEST_RETURN, LENGTH, TargetEnv, make_env

WIDTH = 16
# One layer sees the whole height; the place of the bar comes out as numbers.
SEES = EncoderCfg(
    channels=(4,), kernel_sizes=(3,), strides=(1,), spatial_softmax=True, activation="elu"
)
DATA = DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=4)


class SeenTargetEnv(TargetEnv):
    """The target is seen as a red bar at its place, left at -1 and right at 1; "actor" is noise, the critic knows."""

    def __init__(self, num_envs=16):
        super().__init__(num_envs)
        self.observation_spec["rgb"] = Unbounded((num_envs, 4, WIDTH, 3), dtype=torch.uint8)

    def _observe(self, **flags):
        data = super()._observe(**flags)
        column_E1 = ((self.target_E1 + 1) / 2 * (WIDTH - 1)).round()
        is_bar_EW = torch.arange(WIDTH) == column_E1
        rgb_EHWC = torch.zeros(len(column_E1), 4, WIDTH, 3, dtype=torch.uint8)
        rgb_EHWC[..., 0] = 255 * is_bar_EW[:, None]
        return data.set("rgb", rgb_EHWC).set("actor", torch.zeros_like(self.target_E1))


def seeing_env(num_envs=16):
    return make_env(num_envs, kind=SeenTargetEnv, noise=1.0)


def actor_for(env, make=make_actor):
    cfg = ActorCfg(in_keys=("rgb",), encoders={"rgb": SEES}, hidden_dims=(32,), init_std=0.5)
    return make_for_spec(make, cfg, env.observation_spec, action_spec=env.full_action_spec)


def evaluate(env, actor):
    return Evaluator(env, actor, max_steps=LENGTH, seed=7)().return_mean


def test_an_env_with_pictures_passes_all_checks():
    check_env(seeing_env(4), skip=("actions",))


def make_ppo(env, *, actor):
    critic = make_for_spec(make_critic, CriticCfg(hidden_dims=(16,)), env.observation_spec)
    cfg = PPOCfg(num_epochs=4, learning_rate=1e-2, schedule="fixed", clip_value=False)
    update = PPOUpdate(cfg, actor=actor, critic=critic, data=DATA)
    return update, RolloutCollector(env, actor, rollout_length=16, keys=update.rollout_keys)


def test_a_rollout_keeps_bytes_and_an_update_never_waits_for_the_device():
    env = seeing_env()
    actor = actor_for(env)
    update, collector = make_ppo(env, actor=actor)
    # The critic sees no picture, so none of the state that follows is kept; features are never.
    pictures = [key for key in update.rollout_keys if "rgb" in key or "encoded" in key]
    assert pictures == ["rgb"]
    assert fused_networks(actor, update.critic).reason == "the networks read pictures"
    update(collector.collect())
    rollout_ET = collector.collect()
    assert rollout_ET["rgb"].dtype == torch.uint8
    with count_syncs() as syncs:
        update(rollout_ET)
    assert syncs.total == 0, syncs.report()


@pytest.mark.full
def test_losses_of_policies_that_see_compile_without_a_break():
    env = seeing_env(8)
    actor = actor_for(env)
    update, _ = make_ppo(env, actor=actor)
    data = actor(env.reset()).detach().exclude("encoded")
    data["advantage"] = torch.randn(8, 1)
    data["value_target"] = torch.randn(8, 1)
    data["state_value"] = torch.zeros(8, 1)
    loss = make_loss(PPOCfg(), actor, update.critic)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(data.clone())
    for name, value in loss(data.clone()).items():
        torch.testing.assert_close(compiled[name], value)


@pytest.mark.full
def test_ppo_learns_from_pictures_what_the_critic_knows():
    torch.manual_seed(0)
    env = seeing_env()
    actor = actor_for(env)
    update, collector = make_ppo(env, actor=actor)
    for _ in range(16):
        update(collector.collect())
    assert evaluate(env, actor) > 0.85 * BEST_RETURN
    # Black pictures: nothing else shows the target.
    with torch.no_grad():
        for weight in actor[0].module.parameters():
            weight.zero_()
    assert evaluate(env, actor) < 0.85 * BEST_RETURN


@pytest.mark.full
def test_a_recurrent_student_that_sees_is_taught_by_one_that_knows():
    torch.manual_seed(0)
    base = seeing_env(64)

    def make(cfg, **sizes):
        return make_recurrent_actor(RecurrentCfg(kind="gru", hidden_dim=16), cfg, **sizes)

    student = actor_for(base, make)
    env = base
    for transform in recurrent_transforms(
        base, *(own.make_tensordict_primer() for own in recurrent_modules(student))
    ):
        env.append_transform(transform)
    cfg = ActorCfg(in_keys=("critic",), hidden_dims=(), obs_normalization=False)
    knows = make_actor(cfg, obs_dim=1, action_dim=1)
    with torch.no_grad():
        knows[0].module.head.loc.weight.fill_(1.0)
    teacher = Teacher(policy=knows.requires_grad_(False).eval())
    data = DatasetCfg(num_env_states_per_minibatch=128, num_minibatches=4, sequence_length=4)
    update = DistillationUpdate(
        DistillationCfg(teacher="toy", learning_rate=0.01, num_epochs=4),
        actor=student,
        teacher=teacher,
        data=data,
        seed=0,
    )
    collector = RolloutCollector(env, update.behavior, rollout_length=8, keys=update.rollout_keys)
    for _ in range(10):
        update(collector.collect())
    assert evaluate(env, student) > 0.85 * BEST_RETURN


@pytest.mark.full
def test_sac_learns_from_pictures():
    torch.manual_seed(0)
    env = seeing_env()
    update = make_update("fast_sac", env, sees={"encoders": {"rgb": SEES}, "in_keys": ("rgb",)})
    collector = RolloutCollector(env, update.behavior, rollout_length=4, keys=update.rollout_keys)
    for _ in range(100):
        update(collector.collect())
    assert update.replay.storage.get(torch.arange(4))["rgb"].dtype == torch.uint8
    assert evaluate(env, update.actor) > 0.85 * BEST_RETURN
