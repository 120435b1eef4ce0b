"""A learning problem of pure torch whose best return is known, so that trainers are tested without physics."""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded

from ksim_rl.collectors import RolloutCollector
from ksim_rl.data import DatasetCfg
from ksim_rl.device import random
from ksim_rl.envs import MaskedTransformedEnv
from ksim_rl.envs.contract import EpisodeClock, EpisodeSums
from ksim_rl.envs.masked_reset import MaskedReset
from ksim_rl.modules import ActorCfg, CriticCfg, make_actor, make_critic
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers import Evaluator, PPOUpdate, Trainer, TrainerCfg
from ksim_rl.transforms import GaussianNoise, ObservationNoise

LENGTH = 8
BEST_RETURN = float(LENGTH)


class TargetEnv(MaskedReset):
    """Each step shows a target x in [-1, 1]; the reward is 1 - (action - x)^2, so the best return is 8.

    An episode lasts 8 steps and is truncated. `terminate_at` cuts it short with a termination instead.
    """

    max_episode_length = LENGTH
    max_episode_length_s = LENGTH * 0.5
    step_dt = 0.5

    def __init__(self, num_envs=16, terminate_at=None):
        super().__init__(device=torch.device("cpu"), batch_size=[num_envs])
        self.terminate_at = terminate_at
        self.seed_value = torch.tensor(0)
        self.step_E = torch.zeros(num_envs, dtype=torch.int64)
        self.episode_E = torch.zeros(num_envs, dtype=torch.int64)
        self.target_E1 = torch.zeros(num_envs, 1)
        self.return_E = torch.zeros(num_envs)
        self.totals = {
            name: torch.tensor(0.0)
            for name in ("episodes", "length_sum", "return_sum", "reward/hit")
        }
        self.totals["termination/non_finite"] = torch.tensor(0.0)
        vector, flag = Unbounded((num_envs, 1)), Binary(1, (num_envs, 1), dtype=torch.bool)
        shape = [num_envs]
        self.observation_spec = Composite(actor=vector.clone(), critic=vector.clone(), shape=shape)
        self.full_action_spec = Composite(action=vector.clone(), shape=shape)
        self.full_reward_spec = Composite(reward=vector.clone(), shape=shape)
        self.full_done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _observe(self, **flags):
        keys = random.row_keys(
            self.seed_value, 1, self.episode_E * 100 + self.step_E, self.batch_size[0]
        )
        self.target_E1 = random.uniform(keys, 1, -1.0, 1.0)
        clean = {"actor": self.target_E1, "critic": self.target_E1.clone()}
        return TensorDict({**clean, **flags}, batch_size=self.batch_size)

    def _step(self, tensordict):
        reward_E1 = 1.0 - (tensordict["action"] - self.target_E1).square()
        self.step_E += 1
        self.return_E += reward_E1[:, 0]
        terminated_E1 = (
            (self.step_E == self.terminate_at)[:, None]
            if self.terminate_at
            else torch.zeros_like(reward_E1, dtype=torch.bool)
        )
        truncated_E1 = (self.step_E >= LENGTH)[:, None] & ~terminated_E1
        done_E1 = terminated_E1 | truncated_E1
        done_E = done_E1[:, 0]
        self.totals["episodes"] += done_E.sum()
        self.totals["length_sum"] += (self.step_E * done_E).sum()
        self.totals["return_sum"] += (self.return_E * done_E).sum()
        self.totals["reward/hit"] += (self.return_E * done_E).sum()
        return self._observe(
            reward=reward_E1, done=done_E1, terminated=terminated_E1, truncated=truncated_E1
        )

    def _reset(self, tensordict=None, **_):
        mask_E = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():
            mask_E = tensordict["_reset"].reshape(-1)
        self.step_E.masked_fill_(mask_E, 0)
        self.return_E.masked_fill_(mask_E, 0.0)
        self.episode_E += mask_E
        no_E1 = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._observe(done=no_E1, terminated=no_E1.clone(), truncated=no_E1.clone())

    def _set_seed(self, seed):
        self.seed_value.fill_(seed or 0)
        self.episode_E.zero_()

    def episode_log(self):
        return dict(self.totals)

    def episode_log_reset_(self):
        for total in self.totals.values():
            total.zero_()

    def _kept(self):
        names = ("seed_value", "step_E", "episode_E", "return_E", "target_E1")
        return {name: getattr(self, name) for name in names} | {
            f"log/{k}": v for k, v in self.totals.items()
        }

    def state_dict(self, *_, **__):
        return {name: value.clone() for name, value in self._kept().items()}

    def load_state_dict(self, state_dict, *_, **__):
        for name, value in self._kept().items():
            value.copy_(state_dict[name])


EpisodeClock.register(TargetEnv)
EpisodeSums.register(TargetEnv)


def make_env(num_envs=16, *, seed=0, noise=0.0, kind=TargetEnv, **options):
    """Return the env with sensor noise on what the actor sees."""
    transform = ObservationNoise(["actor"], noise=GaussianNoise(std=noise))
    env = MaskedTransformedEnv(kind(num_envs, **options), transform)
    env.set_seed(seed)
    return env


def make_trainer(
    folder=None,
    *,
    seed=0,
    iterations=6,
    noise=0.05,
    loggers=(),
    hooks=(),
    solved_at=None,
    env=None,
    ppo=None,
    config=None,
    **cfg,
):
    """Return a trainer for `TargetEnv`; `cfg` are fields of `TrainerCfg`, `ppo` fields of `PPOCfg`."""
    torch.manual_seed(seed)
    env = make_env(seed=seed, noise=noise) if env is None else env
    actor = make_actor(
        ActorCfg(hidden_dims=(16,), init_std=0.5),
        obs_dim=1,
        action_dim=1,
        action_spec=env.action_spec,
    )
    critic = make_critic(CriticCfg(hidden_dims=(16,)), obs_dim=1)
    data = DatasetCfg(num_env_states_per_minibatch=64, num_minibatches=4)
    ppo_cfg = PPOCfg(**{"num_epochs": 4, "learning_rate": 3e-3, "desired_kl": 0.02, **(ppo or {})})
    update = PPOUpdate(ppo_cfg, actor=actor, critic=critic, data=data, seed=seed)
    rollout_length = data.rollout_length(env.batch_size[0])
    evaluation_env = make_env(10, noise=noise)
    evaluation_env.eval()
    fields = {"num_iterations": iterations, "eval_interval": 0, "checkpoint_interval": 0, **cfg}
    trainer = Trainer(
        TrainerCfg(**fields),
        collector=RolloutCollector(
            env, actor, rollout_length=rollout_length, keys=update.rollout_keys
        ),
        update=update,
        evaluator=Evaluator(evaluation_env, actor, max_steps=LENGTH, seed=7),
        solved_at=solved_at,
        hooks=hooks,
        folder=folder,
        config=config,
    )
    trainer.loggers = loggers
    return trainer


class MemoryLogger:
    """Keeps what it is given."""

    def __init__(self):
        self.rows, self.closed = [], False

    def log_metrics(self, metrics, step):
        self.rows.append({"step": step, **metrics})

    def close(self):
        self.closed = True
