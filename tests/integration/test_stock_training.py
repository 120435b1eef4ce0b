"""PPO on cartpole_balance with TorchRL's own parts only: collector, GAE, replay buffer, sampler, loss."""

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, RewardSum, StepCounter
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from ksim_rl import envs

E, T, ITERATIONS, EPOCHS, B = 64, 32, 14, 4, 256


def stock_actor_and_critic(env):
    obs_dim, action_dim = env.observation_spec["actor"].shape[-1], env.action_spec.shape[-1]
    network = nn.Sequential(
        MLP(
            in_features=obs_dim,
            out_features=2 * action_dim,
            num_cells=[64, 64],
            activation_class=nn.Tanh,
        ),
        NormalParamExtractor(scale_mapping="biased_softplus_0.5"),
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["actor"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec,
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = MLP(in_features=obs_dim, out_features=1, num_cells=[64, 64], activation_class=nn.Tanh)
    return actor, ValueOperator(critic, in_keys=["critic"])


@pytest.mark.full
def test_stock_ppo_learns_to_balance():
    torch.manual_seed(0)
    env = TransformedEnv(
        envs.make("cartpole_balance", num_envs=E, seed=0), Compose(RewardSum(), StepCounter())
    )
    actor, critic = stock_actor_and_critic(env)
    collector = Collector(
        env,
        actor,
        frames_per_batch=E * T,
        total_frames=E * T * ITERATIONS,
        auto_register_policy_transforms=False,
    )
    advantage = GAE(gamma=0.95, lmbda=0.9, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.001, critic_coeff=0.5)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-3)
    dataset = ReplayBuffer(
        storage=LazyTensorStorage(E * T), sampler=SamplerWithoutReplacement(), batch_size=B
    )
    falls, lengths, losses = [], [], []
    for rollout_ET in collector:
        falls.append(float(rollout_ET["next", "terminated"].float().mean()))
        lengths.append(float(rollout_ET["next", "step_count"].float().mean()))
        for _ in range(EPOCHS):
            advantage(rollout_ET)
            dataset.extend(rollout_ET.reshape(-1))
            for _ in range(E * T // B):
                parts = loss(dataset.sample())
                total = parts["loss_objective"] + parts["loss_entropy"] + parts["loss_critic"]
                optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                losses.append(total.detach())
    assert torch.stack(losses).isfinite().all()
    assert len(losses) == ITERATIONS * EPOCHS * E * T // B
    assert sum(falls[-3:]) < 0.6 * sum(falls[1:4]), f"falls per step, by iteration: {falls}"
    # Each fall starts another episode, so fewer of them are longer episodes.
    assert max(lengths[-3:]) > 1.5 * lengths[1], (
        f"mean steps since the reset, by iteration: {lengths}"
    )
