"""Networks that are not ours learn like ours; stochastic policies are in `tests/trainers/test_networks.py`."""

import pytest
import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.envs import InitTracker
from torchrl.modules import (
    GRUModule,
    LSTMModule,
    NormalParamExtractor,
    TanhNormal,
    ValueOperator,
    set_recurrent_mode,
)

from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg, ReplayCfg
from ksim_rl.modules import ExploringPolicy, recurrent_modules
from ksim_rl.objectives import PPOCfg, TD3Cfg, TD3Loss
from ksim_rl.trainers import Evaluator, OffPolicyUpdate, PPOUpdate
from tests.trainers.target_env import BEST_RETURN, LENGTH, make_env

RECURRENT = {"lstm": LSTMModule, "gru": GRUModule}


def recurrent_problem(kind):
    """Return an env that carries the state of TorchRL's recurrent module, and a policy behind it."""
    env = make_env()
    recurrent = RECURRENT[kind](input_size=1, hidden_size=8, in_key="actor", out_key="features")
    env.append_transform(InitTracker())
    env.append_transform(recurrent.make_tensordict_primer())
    head = nn.Sequential(nn.Linear(8, 2), NormalParamExtractor())
    actor = ProbabilisticTensorDictSequential(
        recurrent,
        TensorDictModule(head, in_keys=["features"], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": -2.0, "high": 2.0},
            return_log_prob=True,
            default_interaction_type="random",
        ),
    )
    return env, recurrent, actor


def ppo_update(actor, critic, **data):
    ppo = PPOCfg(num_epochs=4, learning_rate=1e-2, schedule="fixed", clip_value=False)
    data = DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=4, **data)
    return PPOUpdate(ppo, actor=actor, critic=critic, data=data)


def value():
    return ValueOperator(
        nn.Sequential(nn.Linear(1, 16), nn.ELU(), nn.Linear(16, 1)), in_keys=["critic"]
    )


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        pytest.param("lstm", {}, marks=pytest.mark.full),
        ("gru", {"sequence_length": 4, "burn_in": 4}),
        pytest.param("lstm", {"sequence_length": 4, "burn_in": 4}, marks=pytest.mark.full),
        pytest.param("gru", {}, marks=pytest.mark.full),
    ],
)
def test_torchrls_recurrent_modules_learn_on_sequences(kind, data):
    torch.manual_seed(0)
    env, recurrent, actor = recurrent_problem(kind)
    update = ppo_update(actor, value(), **data)
    assert recurrent_modules(actor) == [recurrent]
    collector = RolloutCollector(env, actor, rollout_length=16, keys=update.rollout_keys)
    rollout_ET = collector.collect()
    update.advantage(rollout_ET)
    update.dataset.extend(rollout_ET)
    with torch.no_grad(), set_recurrent_mode(True):
        for minibatch_BT in update.dataset.epoch():
            # What comes before a sequence to renew its state is no part of it.
            own_BT = minibatch_BT[:, data.get("burn_in", 0) :].copy()
            log_prob_BT = actor.get_dist(own_BT).log_prob(own_BT["action"])
            torch.testing.assert_close(log_prob_BT, own_BT["action_log_prob"], atol=1e-5, rtol=1e-5)
    for _ in range(10):
        update(collector.collect())
    assert Evaluator(env, actor, max_steps=LENGTH, seed=7)().return_mean > 0.75 * BEST_RETURN


def test_a_critic_needs_the_state_after_each_step():
    _, recurrent, actor = recurrent_problem("lstm")
    critic = ValueOperator(nn.Linear(8, 1), in_keys=["features"])
    with pytest.raises(ValueError, match="critic=LSTMModule.*use a RecurrentModule"):
        ppo_update(actor, TensorDictSequential(recurrent, critic))


class ActionValue(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2, 64), nn.SiLU(), nn.Linear(64, 1))

    def forward(self, obs, action):
        return self.layers(torch.cat([obs, action], -1))


def test_plain_layers_learn_off_policy():
    torch.manual_seed(0)
    env = make_env()
    actor = TensorDictModule(
        nn.Sequential(nn.Linear(1, 32), nn.SiLU(), nn.Linear(32, 1)), ["actor"], ["action"]
    )
    critic = TensorDictModule(ActionValue(), ["critic", "action"], ["state_action_value"])
    low, high = torch.tensor([[-2.0], [2.0]])
    cfg = TD3Cfg(
        gamma=0.0,
        critic_learning_rate=3e-3,
        actor_learning_rate=3e-3,
        exploration_noise_min=0.05,
        exploration_noise_max=0.3,
    )
    update = OffPolicyUpdate(
        cfg,
        loss=TD3Loss(actor, critic, low_L=low, high_L=high, gamma=0.0),
        behavior=ExploringPolicy(
            actor, low_L=low, high_L=high, num_envs=16, noise_min=0.05, noise_max=0.3
        ),
        data=ReplayCfg(
            num_env_states_per_minibatch=128,
            num_minibatches=8,
            num_steps=4,
            capacity=200,
            learning_starts=8,
        ),
        num_envs=16,
    )
    collector = RolloutCollector(env, update.behavior, rollout_length=4, keys=update.rollout_keys)
    for _ in range(60):
        update(collector.collect())
    assert Evaluator(env, actor, max_steps=LENGTH, seed=7)().return_mean > 0.75 * BEST_RETURN
