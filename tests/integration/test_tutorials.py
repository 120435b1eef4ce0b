"""Scripts in the manner of TorchRL's tutorials on our envs, with TorchRL's parts only: SAC, recurrent networks, PPO.

TorchRL's PPO tutorial on cartpole is `test_stock_training.py`, which runs until it has learned something.
"""

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import (
    MLP,
    LSTMModule,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import ClipPPOLoss, SACLoss, SoftUpdate
from torchrl.objectives.value import GAE

from ksim_rl import envs
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.testing import CounterEnv
from ksim_rl.transforms import ActionDelay, ActionLowPass, DelayCfg

E = 4


@pytest.fixture(params=["ours", "stock wrapper"])
def env(request):
    made = envs.make(
        "cartpole_balance", num_envs=E, seed=0, overrides=["task.episode_length_s=0.2"]
    )
    yield (
        made
        if request.param == "ours"
        else TransformedEnv(made, Compose(RewardSum(), StepCounter()))
    )
    if not made.is_closed:  # by the collector, at its end
        made.close()


def actor_of(env, distribution, **options):
    low_high = {"low": env.action_spec.space.low[0], "high": env.action_spec.space.high[0]}
    net = nn.Sequential(
        MLP(in_features=5, out_features=2, num_cells=[32, 32]), NormalParamExtractor()
    )
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["actor"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec,
        distribution_class=distribution,
        distribution_kwargs=low_high if options.pop("bounded", False) else {},
        return_log_prob=True,
        **options,
    )


def moved(modules, before):
    after = [parameter for module in modules for parameter in module.parameters()]
    assert all(parameter.isfinite().all() for parameter in after)
    return all(not torch.equal(one, other) for one, other in zip(before, after, strict=True))


def copies(*modules):
    return [parameter.detach().clone() for module in modules for parameter in module.parameters()]


def test_sac(env):
    torch.manual_seed(0)
    actor = actor_of(env, TanhNormal)
    critic = ValueOperator(
        MLP(in_features=6, out_features=1, num_cells=[32]), in_keys=["actor", "action"]
    )
    loss = SACLoss(actor, critic, num_qvalue_nets=2, action_spec=env.full_action_spec)
    loss.make_value_estimator(gamma=0.99)
    targets = SoftUpdate(loss, eps=0.95)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(400), batch_size=64)
    before = copies(actor)
    sizes = {"frames_per_batch": 20 * E, "total_frames": 60 * E}
    for batch_ET in Collector(env, actor, init_random_frames=20 * E, **sizes):
        replay.extend(batch_ET.reshape(-1))
        for _ in range(4):
            out = loss(replay.sample())
            total = out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]
            assert total.isfinite()
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
            targets.step()
    assert moved([actor], before)


def test_recurrent_ppo(env):
    torch.manual_seed(0)
    lstm = LSTMModule(input_size=5, hidden_size=16, in_key="actor", out_key="features")
    env = TransformedEnv(env, Compose(InitTracker(), lstm.make_tensordict_primer()))
    head = nn.Sequential(nn.Linear(16, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictSequential(
            lstm, TensorDictModule(head, in_keys=["features"], out_keys=["loc", "scale"])
        ),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(in_features=5, out_features=1, num_cells=[32]), in_keys=["actor"])
    loss = ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before = copies(actor)
    for rollout_ET in Collector(env, actor, frames_per_batch=40 * E, total_frames=80 * E):
        assert rollout_ET["is_init"].sum() > E, "episodes begin within the rollout"
        assert (rollout_ET["recurrent_state_h"][rollout_ET["is_init"].squeeze(-1)] == 0).all()
        GAE(gamma=0.95, lmbda=0.9, value_network=critic)(rollout_ET)
        with set_recurrent_mode(True):
            out = loss(rollout_ET)
        total = out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert moved([actor], before)


def test_ppo_of_the_tutorial_with_bounds_from_the_spec(env):
    torch.manual_seed(0)
    actor = actor_of(env, TanhNormal, bounded=True)
    critic = ValueOperator(MLP(in_features=5, out_features=1, num_cells=[32]), in_keys=["actor"])
    loss = ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    before = copies(actor, critic)
    for rollout_ET in Collector(env, actor, frames_per_batch=20 * E, total_frames=40 * E):
        GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)(rollout_ET)
        out = loss(rollout_ET.reshape(-1))
        total = out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert moved([actor, critic], before)


WITH_BUFFERS = {
    "none": lambda: None,
    "delay": lambda: ActionDelay(delay=DelayCfg(min_lag=1, max_lag=1)),
    "low pass": lambda: ActionLowPass(alpha=0.5),
}


@pytest.mark.parametrize("make", WITH_BUFFERS.values(), ids=WITH_BUFFERS)
@pytest.mark.parametrize("wrap", [MaskedTransformedEnv, TransformedEnv])
@pytest.mark.parametrize("inner", ["ours", "counter"])
def test_a_policy_outside_of_no_grad_keeps_its_gradients(make, wrap, inner):
    """Buffers of env and transforms change in place, which gradients of the action would forbid."""
    if inner == "ours":
        base, key, size = envs.make("cartpole_balance", num_envs=E, seed=0), "actor", 1
    else:
        base, key, size = CounterEnv((3, 4, 5, 6)), "count", 2
    transform = make()
    env = base if transform is None else wrap(base, transform)
    layer = nn.Linear(env.full_observation_spec[key].shape[-1], size)
    policy = TensorDictModule(layer, in_keys=[key], out_keys=["action"])
    rollout_ET = env.rollout(6, policy, break_when_any_done=False)
    assert rollout_ET["action"].requires_grad
    if inner == "ours":
        assert not rollout_ET["next", "reward"].requires_grad
        assert not rollout_ET["next", key].requires_grad
    rollout_ET["action"].square().sum().backward()
    assert layer.weight.grad.isfinite().all() and layer.bias.grad.abs().sum() > 0
    base.close()
