"""A task that needs memory: recurrent networks solve it, and the best memoryless policy's return is known."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded

from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.device import random
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.modules import (
    ActorCfg,
    CriticCfg,
    RecurrentCfg,
    make_actor,
    make_critic,
    make_recurrent_actor,
    make_recurrent_critic,
    recurrent_transforms,
)
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import Evaluator, PPOUpdate

LENGTH = 5
NUM_ENVS = 64


class RecallEnv(MaskedReset):
    """Shows a cue, -1 or 1 with equal odds, at the first step only; the last step's reward is 1 - (action - cue)^2.

    All other rewards are zero. The best return of a policy that remembers is 1. One that sees only the present
    observation, which at the last step is the same whatever the cue was, has at best
    max_a E[1 - (a - cue)^2] = max_a (1 - a^2 - 1) = 0, at a = 0.
    """

    def __init__(self, num_envs):
        super().__init__(device=torch.device("cpu"), batch_size=[num_envs])
        self.seed_value = torch.tensor(0)
        self.step_E = torch.zeros(num_envs, dtype=torch.int64)
        self.episode_E = torch.zeros(num_envs, dtype=torch.int64)
        vector, one, flag = (
            Unbounded((num_envs, 2)),
            Unbounded((num_envs, 1)),
            Binary(1, (num_envs, 1), dtype=torch.bool),
        )
        shape = [num_envs]
        self.observation_spec = Composite(actor=vector, critic=vector.clone(), shape=shape)
        self.full_action_spec = Composite(action=one, shape=shape)
        self.full_reward_spec = Composite(reward=one.clone(), shape=shape)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _observe(self, **values):
        keys = random.row_keys(self.seed_value, 1, self.episode_E, self.batch_size[0])
        self.cue_E1 = torch.where(random.uniform(keys, 1) < 0.5, -1.0, 1.0)
        shown_E1 = torch.where(self.step_E[:, None] == 0, self.cue_E1, 0.0)
        last_E1 = (self.step_E[:, None] == LENGTH - 1).float()
        obs_E = torch.cat([shown_E1, last_E1], -1)
        return TensorDict(
            {"actor": obs_E, "critic": obs_E.clone(), **values}, batch_size=self.batch_size
        )

    def _step(self, tensordict):
        self.step_E += 1
        done_E1 = (self.step_E >= LENGTH)[:, None]
        reward_E1 = torch.where(done_E1, 1.0 - (tensordict["action"] - self.cue_E1).square(), 0.0)
        return self._observe(
            reward=reward_E1,
            done=done_E1,
            terminated=done_E1.clone(),
            truncated=torch.zeros_like(done_E1),
        )

    def _reset(self, tensordict=None, **_):
        mask_E = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask_E = tensordict["_reset"].reshape(-1)
        self.step_E.masked_fill_(mask_E, 0)
        self.episode_E += mask_E
        no_E1 = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._observe(done=no_E1, terminated=no_E1.clone(), truncated=no_E1.clone())

    def _set_seed(self, seed):
        self.seed_value.fill_(seed or 0)
        self.episode_E.zero_()


def trained(kind, **sequences):
    """Return the mean return of the trained policy's mean action."""
    torch.manual_seed(0)
    env, evaluation_env = (MaskedTransformedEnv(RecallEnv(n)) for n in (NUM_ENVS, 256))
    hidden_dims = (32,) if kind is None else ()
    actor_cfg = ActorCfg(hidden_dims=hidden_dims, init_std=0.5, obs_normalization=False)
    critic_cfg = CriticCfg(hidden_dims=hidden_dims, obs_normalization=False)
    if kind is None:
        actor, critic = (
            make_actor(actor_cfg, obs_dim=2, action_dim=1),
            make_critic(critic_cfg, obs_dim=2),
        )
    else:
        memory = RecurrentCfg(kind=kind, hidden_dim=16)
        actor = make_recurrent_actor(memory, actor_cfg, obs_dim=2, action_dim=1)
        critic = make_recurrent_critic(memory, critic_cfg, obs_dim=2)
        for each in (env, evaluation_env):
            for transform in recurrent_transforms(each, actor[0].make_tensordict_primer()):
                each.append_transform(transform)
    env.set_seed(1)
    # 8 steps per rollout: episodes of 5 steps begin and end anywhere in them, and states cross from one to the next.
    data = DatasetCfg(num_env_states_per_minibatch=256, num_minibatches=2, **sequences)
    ppo = PPOCfg(num_epochs=4, learning_rate=2e-2, schedule="fixed", entropy_coeff=0.0)
    update = PPOUpdate(ppo, actor=actor, critic=critic, data=data)
    collector = RolloutCollector(env, actor, rollout_length=8, keys=update.rollout_keys)
    for _ in range(20):
        update(collector.collect())
    evaluation = Evaluator(evaluation_env, actor, max_steps=LENGTH, seed=7)()
    assert evaluation is not None and evaluation.unfinished == 0
    return evaluation.return_mean


@pytest.mark.parametrize(
    ("kind", "sequences"),
    [
        pytest.param("lstm", {}, marks=pytest.mark.full),
        pytest.param("gru", {}, marks=pytest.mark.full),
        pytest.param("lstm", {"sequence_length": 4}, marks=pytest.mark.full),
        ("gru", {"sequence_length": 4, "burn_in": 2}),
    ],
)
def test_a_recurrent_policy_recalls_the_cue(kind, sequences):
    assert trained(kind, **sequences) > 0.8


def test_a_policy_without_memory_cannot():
    # In 256 episodes a policy that always plays a gains -a^2 + 2 a * (mean cue), whose standard deviation is 1 / 16: at
    # most the mean cue squared, 0.06 where that is four standard deviations off.
    assert trained(None) < 0.06
