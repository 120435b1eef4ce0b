"""A whole algorithm, REINFORCE with a mean baseline, which a test installs as a package of its own."""

from dataclasses import dataclass

import torch

from ksim_rl.algorithms import Algorithm
from ksim_rl.algorithms.ppo import DATA, make_ppo_policy
from ksim_rl.objectives import AlgorithmCfg


@dataclass(frozen=True, kw_only=True)
class MineCfg(AlgorithmCfg):
    learning_rate: float = 3e-3


class MineUpdate:
    rollout_keys = ("actor", "action", ("next", "reward"))

    def __init__(self, cfg, env, resumed):
        self.device, self.num_env_states = cfg.resolved_device(), cfg.data.num_env_states
        self.actor = self.behavior = make_ppo_policy(cfg, env)
        self.optimizer = torch.optim.Adam(self.actor.parameters(), cfg.objective.learning_rate)
        self.loss = torch.zeros((), device=self.device)

    def __call__(self, rollout_ET):
        reward_ET = rollout_ET["next", "reward"].squeeze(-1)
        return_ET = reward_ET.flip(1).cumsum(1).flip(1)
        log_prob_ET = self.actor.get_dist(rollout_ET.clone()).log_prob(rollout_ET["action"])
        loss = -((return_ET - return_ET.mean(0)) * log_prob_ET).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.loss.copy_(loss.detach())

    def metrics(self):
        return {"loss/policy": self.loss, "update/skipped_steps": torch.zeros_like(self.loss)}

    def check(self, metrics):
        assert metrics["loss/policy"] == metrics["loss/policy"], "not a number"

    def state_dict(self):
        return {"actor": self.actor.state_dict()}

    def load_state_dict(self, state):
        self.load_weights(state)

    def load_weights(self, state):
        self.actor.load_state_dict(state["actor"])


MINE = Algorithm(name="mine", cfg=MineCfg, update=MineUpdate, policy=make_ppo_policy, data=DATA)
