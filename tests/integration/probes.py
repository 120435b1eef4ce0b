"""Tiny envs whose values and best actions are known in closed form, and our real parts put together around them."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.device import random
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import PPOUpdate

GAMMA = 0.5
E, T = 32, 8


class ProbeEnv(MaskedReset):
    """Episodes of `length` steps that end by termination or, with `truncates`, by truncation.

    Args:
        observe: (step_E, sign_E) -> [E, L]; the sign, 1 or -1, is drawn at each reset.
        reward: (step_E, sign_E, action_E, first_action_E) -> [E], of the state that the action was taken in; the first
            action is the first of the episode.
        length: steps of an episode.
        truncates: how it ends.
    """

    def __init__(self, observe, reward, *, length, truncates=False, num_envs=E):
        super().__init__(device=torch.device("cpu"), batch_size=[num_envs])
        self.observe, self.reward_of, self.length, self.truncates = (
            observe,
            reward,
            length,
            truncates,
        )
        self.seed_value = torch.tensor(0)
        self.step_E = torch.zeros(num_envs, dtype=torch.int64)
        self.episode_E = torch.zeros(num_envs, dtype=torch.int64)
        self.sign_E, self.first_E = torch.ones(num_envs), torch.zeros(num_envs)
        obs = Unbounded((num_envs, observe(self.step_E, self.sign_E).shape[-1]))
        vector, flag = Unbounded((num_envs, 1)), Binary(1, (num_envs, 1), dtype=torch.bool)
        shape = [num_envs]
        self.observation_spec = Composite(actor=obs.clone(), critic=obs.clone(), shape=shape)
        self.full_action_spec = Composite(action=vector.clone(), shape=shape)
        self.full_reward_spec = Composite(reward=vector.clone(), shape=shape)
        flags = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**flags, shape=shape)

    def _state(self, done_E1, **values):
        obs_EL = self.observe(self.step_E, self.sign_E)
        no_E1 = torch.zeros_like(done_E1)
        flags = {"done": done_E1, "terminated": no_E1, "truncated": no_E1.clone()}
        flags["truncated" if self.truncates else "terminated"] = done_E1.clone()
        return TensorDict(
            {"actor": obs_EL, "critic": obs_EL.clone(), **flags, **values}, self.batch_size
        )

    def _step(self, tensordict):
        action_E = tensordict["action"][:, 0]
        self.first_E = torch.where(self.step_E == 0, action_E, self.first_E)
        reward_E = self.reward_of(self.step_E, self.sign_E, action_E, self.first_E)
        self.step_E = self.step_E + 1
        return self._state((self.step_E >= self.length)[:, None], reward=reward_E[:, None].float())

    def _reset(self, tensordict=None, **_):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask_E = (
            torch.ones_like(self.step_E, dtype=torch.bool) if mask is None else mask.reshape(-1)
        )
        self.episode_E = self.episode_E + mask_E
        keys = random.row_keys(self.seed_value, 1, self.episode_E, len(mask_E))
        drawn_E = torch.where(random.uniform(keys, 1)[:, 0] < 0.5, -1.0, 1.0)
        self.step_E = torch.where(mask_E, 0, self.step_E)
        self.sign_E = torch.where(mask_E, drawn_E, self.sign_E)
        return self._state(torch.zeros_like(mask_E)[:, None])

    def _set_seed(self, seed):
        self.seed_value.fill_(seed or 0)
        self.episode_E.zero_()


class Run:
    """A probe env with our collector and our PPO update: D = 256 env states, 6 gradient steps each."""

    def __init__(self, env, *, normalized=False, **ppo):
        self.env = env
        env.set_seed(0)
        torch.manual_seed(0)
        obs_dim = env.observation_spec["actor"].shape[-1]
        options = {"hidden_dims": (32,), "obs_normalization": normalized}
        actor = make_actor(ActorCfg(init_std=0.5, **options), obs_dim=obs_dim, action_dim=1)
        critic = make_critic(CriticCfg(**options), obs_dim=obs_dim)
        defaults = {"gamma": GAMMA, "num_epochs": 3, "schedule": "fixed", "learning_rate": 1e-2}
        defaults |= {"clip_value": False, "entropy_coeff": 0.0}
        data = DatasetCfg(num_env_states_per_minibatch=E * T // 2, num_minibatches=2)
        self.update = PPOUpdate(
            PPOCfg(**{**defaults, **ppo}), actor=actor, critic=critic, data=data
        )
        self.collector = RolloutCollector(
            env, actor, rollout_length=T, keys=self.update.rollout_keys
        )

    def iterate(self, times):
        """Collect and learn."""
        for _ in range(times):
            self.update(self.collector.collect())
        return self

    def values(self, step, sign=1.0):
        """Return the critic's value of a state."""
        obs = self.env.observe(torch.tensor([step]), torch.tensor([sign]))
        with torch.no_grad():
            return float(self.update.critic(TensorDict({"critic": obs}, [1]))["state_value"])

    def action(self, step, sign=1.0):
        """Return the policy's mean action in a state."""
        obs = self.env.observe(torch.tensor([step]), torch.tensor([sign]))
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return float(self.update.actor(TensorDict({"actor": obs}, [1]))["action"])


def blank(step_E, sign_E):
    """Observe nothing."""
    return torch.zeros(len(step_E), 1)


def sign_only(step_E, sign_E):
    """Observe the sign."""
    return sign_E[:, None].clone()


def step_only(step_E, sign_E):
    """Observe which of up to three steps it is; the state after the last reads as the last."""
    return torch.eye(3)[step_E.clamp_max(2)]


def one(step_E, sign_E, action_E, first_E):
    """Pay 1 at each step."""
    return torch.ones_like(sign_E)


def the_sign(step_E, sign_E, action_E, first_E):
    """Pay the sign."""
    return sign_E
