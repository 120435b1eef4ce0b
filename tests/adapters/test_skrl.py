"""The skrl adapter, against the conventions of skrl's own wrappers of vector envs and with its PPO."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn
from torchrl.envs import GymEnv

pytest.importorskip("skrl")
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

from ksim_rl import envs
from ksim_rl.adapters.skrl import SkrlWrapper
from ksim_rl.testing import CounterEnv

LENGTHS = (3, 5, 4)


class Policy(GaussianMixin, Model):
    def __init__(self, env):
        Model.__init__(self, observation_space=env.observation_space, action_space=env.action_space)
        GaussianMixin.__init__(self)
        self.net = nn.Sequential(
            nn.Linear(self.num_observations, 64),
            nn.ELU(),
            nn.Linear(64, 64),
            nn.ELU(),
            nn.Linear(64, self.num_actions),
        )
        self.log_std = nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    def __init__(self, env):
        space = {"observation_space": env.observation_space, "state_space": env.state_space}
        Model.__init__(self, action_space=env.action_space, **space)
        DeterministicMixin.__init__(self)
        self.net = nn.Sequential(
            nn.Linear(self.num_states, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, 1)
        )

    def compute(self, inputs, role=""):
        return self.net(inputs["states"]), {}


def trained(env, *, rollouts, timesteps, folder):
    torch.manual_seed(0)
    cfg = PPO_CFG(
        rollouts=rollouts,
        learning_epochs=8,
        mini_batches=8,
        discount_factor=0.98,
        learning_rate=1e-3,
    )
    cfg.experiment.directory, cfg.experiment.write_interval, cfg.experiment.checkpoint_interval = (
        str(folder),
        0,
        0,
    )
    agent = PPO(
        models={"policy": Policy(env), "value": Value(env)},
        memory=RandomMemory(memory_size=rollouts, num_envs=env.num_envs, device=env.device),
        observation_space=env.observation_space,
        state_space=env.state_space,
        action_space=env.action_space,
        device=env.device,
        cfg=cfg,
    )
    before = {name: value.clone() for name, value in agent.models["policy"].state_dict().items()}
    options = {
        "timesteps": timesteps,
        "headless": True,
        "disable_progressbar": True,
        "close_environment_at_exit": False,
    }
    SequentialTrainer(env=env, agents=agent, cfg=options).train()
    return agent, before


def test_ended_rows_are_reset_and_show_their_last_observation():
    """Even rows of CounterEnv terminate, odd ones are truncated; its observation is its own step."""
    env = SkrlWrapper(CounterEnv(LENGTHS), keys=("count",), state_keys=("row", ("obs", "vector")))
    obs_E1, _ = env.reset()
    assert obs_E1.tolist() == [[0.0]] * 3 and env.state().shape == (3, 4)
    ended = []
    for _ in range(5):
        obs_E1, reward_E1, terminated_E1, truncated_E1, infos = env.step(torch.full((3, 2), 0.5))
        assert reward_E1.tolist() == [[1.0]] * 3
        assert terminated_E1.dtype == truncated_E1.dtype == torch.bool
        assert terminated_E1.shape == truncated_E1.shape == (3, 1)
        assert torch.equal(env.state()[:, 1:2], obs_E1)
        for row in (terminated_E1 | truncated_E1).flatten().nonzero().flatten().tolist():
            assert obs_E1[row] == 0 and infos["final_obs"][row] == LENGTHS[row]
            ended.append((row, bool(truncated_E1[row])))
    assert ended == [(0, False), (2, False), (1, True)]
    kept = env.reset()[0]
    assert torch.equal(kept, obs_E1), "only the first reset resets"


def test_spaces_and_numbers_are_skrls():
    env = SkrlWrapper(envs.make("cartpole_balance", num_envs=2, seed=0), state_keys=("critic",))
    assert (env.num_envs, env.num_agents, env.device) == (2, 1, torch.device("cpu"))
    assert env.observation_space.shape == (5,) and env.action_space.shape == (1,)
    assert np.isinf(env.observation_space.high).all()
    assert env.state_space.shape == (env.state().shape[1],)
    assert SkrlWrapper(CounterEnv(LENGTHS), keys=("count",)).state_space is None
    assert env.render() is None
    env.close()


def test_one_row_and_choices():
    env = SkrlWrapper(GymEnv("CartPole-v1"), keys=("observation",))
    assert env.action_space == spaces.Discrete(2) and env.num_envs == 1
    env.reset()
    obs_E4, *_ = env.step(torch.tensor([[1]]))
    assert obs_E4.shape == (1, 4)
    with pytest.raises(ValueError, match="'actor'"):
        SkrlWrapper(GymEnv("CartPole-v1"))


def test_skrls_ppo_runs(tmp_path):
    env = SkrlWrapper(CounterEnv(LENGTHS), keys=("count", "drawn"), state_keys=("count", "row"))
    agent, before = trained(env, rollouts=8, timesteps=16, folder=tmp_path)
    after = agent.models["policy"].state_dict()
    assert all(value.isfinite().all() for value in after.values())
    assert any(not torch.equal(before[name], value) for name, value in after.items())


@pytest.mark.full
def test_skrls_ppo_learns_cartpole(tmp_path):
    env = SkrlWrapper(envs.make("cartpole_balance", num_envs=64, seed=0), state_keys=("actor",))
    agent, _ = trained(env, rollouts=64, timesteps=4096, folder=tmp_path)
    obs_EL, _ = env.reset()
    total_E1 = torch.zeros(64, 1)
    with torch.no_grad():
        for _ in range(1000):
            action_EL = agent.models["policy"].net(obs_EL)
            obs_EL, reward_E1, *_ = env.step(action_EL)
            total_E1 += reward_E1
    print(f"skrl PPO, 262,144 env states: reward of 1000 steps {total_E1.mean():.1f}")
    assert total_E1.mean() > 800.0
    env.close()
