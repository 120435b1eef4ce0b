"""PPO as single-file implementations write it (in the manner of CleanRL's), through the Gymnasium adapter alone."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import nn
from torch.distributions import Normal

from ksim_rl import envs
from ksim_rl.adapters.gymnasium import GymnasiumVectorEnv

NUM_ENVS, NUM_STEPS, EPOCHS, MINIBATCHES = 16, 64, 4, 4
GAMMA, LAMBDA, CLIP, RATE = 0.98, 0.95, 0.2, 2e-3


class Agent(nn.Module):
    def __init__(self, envs_):
        super().__init__()
        obs = int(np.prod(envs_.single_observation_space.shape))
        actions = int(np.prod(envs_.single_action_space.shape))
        self.critic = nn.Sequential(
            nn.Linear(obs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1)
        )
        self.mean = nn.Sequential(
            nn.Linear(obs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, actions)
        )
        self.log_std = nn.Parameter(torch.zeros(1, actions))
        with torch.no_grad():
            self.mean[-1].weight.mul_(0.01)

    def act(self, obs, action=None):
        dist = Normal(self.mean(obs), self.log_std.expand(len(obs), -1).exp())
        action = dist.sample() if action is None else action
        return (
            action,
            dist.log_prob(action).sum(1),
            dist.entropy().sum(1),
            self.critic(obs).flatten(),
        )


def train(envs_, *, iterations):
    torch.manual_seed(0)
    agent = Agent(envs_)
    optimizer = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)
    obs, _ = envs_.reset(seed=0)
    obs, lengths = torch.as_tensor(obs), []
    for _ in range(iterations):
        rows = []
        for _ in range(NUM_STEPS):
            with torch.no_grad():
                action, log_prob, _, value = agent.act(obs)
            following, reward, terminated, truncated, infos = envs_.step(action.numpy())
            reward = torch.as_tensor(reward)
            if truncated.any():
                last = torch.as_tensor(np.stack([*infos["final_obs"][truncated]]))
                with torch.no_grad():
                    reward[truncated] += GAMMA * agent.critic(last).flatten()
            if "episode" in infos:
                lengths += infos["episode"]["l"][infos["_episode"]].tolist()
            done = torch.as_tensor(terminated | truncated).float()
            rows.append((obs, action, log_prob, value, reward, done))
            obs = torch.as_tensor(following)
        obs_T, action_T, log_prob_T, value_T, reward_T, done_T = (
            torch.stack(part) for part in zip(*rows, strict=True)
        )
        adv_T, running = torch.zeros_like(reward_T), torch.zeros(NUM_ENVS)
        with torch.no_grad():
            value_after = agent.critic(obs).flatten()
        for t in reversed(range(NUM_STEPS)):
            delta = reward_T[t] + GAMMA * (1 - done_T[t]) * value_after - value_T[t]
            running = delta + GAMMA * LAMBDA * (1 - done_T[t]) * running
            adv_T[t], value_after = running, value_T[t]
        data = [
            part.flatten(0, 1) for part in (obs_T, action_T, log_prob_T, adv_T, adv_T + value_T)
        ]
        for _ in range(EPOCHS):
            for index in torch.randperm(len(data[0])).chunk(MINIBATCHES):
                obs_B, action_B, log_prob_B, adv_B, target_B = (part[index] for part in data)
                _, new_log_prob, entropy, value = agent.act(obs_B, action_B)
                ratio = (new_log_prob - log_prob_B).exp()
                adv_B = (adv_B - adv_B.mean()) / (adv_B.std() + 1e-8)
                gain = torch.minimum(ratio * adv_B, ratio.clamp(1 - CLIP, 1 + CLIP) * adv_B)
                loss = (
                    -gain.mean() - 0.001 * entropy.mean() + 0.5 * (value - target_B).square().mean()
                )
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
    return agent, lengths


@pytest.mark.parametrize("iterations", [2, pytest.param(30, marks=pytest.mark.full)])
def test_a_single_file_of_ppo_learns_to_balance(iterations):
    made = envs.make(
        "cartpole_balance", num_envs=NUM_ENVS, seed=0, overrides=["task.episode_length_s=2"]
    )
    vector = gym.wrappers.vector.RecordEpisodeStatistics(GymnasiumVectorEnv(made, keys=["actor"]))
    agent, lengths = train(vector, iterations=iterations)
    assert all(parameter.isfinite().all() for parameter in agent.parameters())
    assert len(lengths) >= NUM_ENVS
    if iterations > 2:
        first, last = np.mean(lengths[:32]), np.mean(lengths[-32:])
        print(
            f"single-file PPO, {iterations * NUM_ENVS * NUM_STEPS} env states: episodes of {first:.0f} -> {last:.0f}"
        )
        assert last > 1.5 * first
    vector.close()
