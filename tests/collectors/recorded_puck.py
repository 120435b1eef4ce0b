"""A puck whose rewards are terms with Python of their own, for tests of what recordings keep of it."""

import warnings
from dataclasses import dataclass

import torch

from ksim_rl import envs
from ksim_rl.collectors import CollectorCfg, RolloutCollector
from ksim_rl.envs.term import RewardTerm
from tests.envs.probe_env import puck_cfg

ROWS, STEPS = 4, 4


def policy(td):
    return td.set("action", torch.zeros(*td.batch_size, 1))


def collector_of(*, rewards, eager=False, **fields):
    """Return a collector for the puck, whose reward is the sum of the terms."""
    cfg = puck_cfg(num_envs=ROWS, rewards=rewards, scale_rewards_by_dt=False, limit=None, **fields)
    env = envs.build(cfg)
    return RolloutCollector(env, policy, rollout_length=STEPS, cfg=CollectorCfg(eager=eager))


def rewards_of(collector, count=1):
    """Return the mean rewards of the next rollouts, without saying that something is recorded again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return [float(collector.collect()["next", "reward"].mean()) for _ in range(count)]


@dataclass(frozen=True, kw_only=True)
class Constant(RewardTerm):
    """The same in all rows: `value()`."""

    scale: float = 1.0

    def value(self):
        return self.scale

    def __call__(self, view):
        return torch.full((view.num_envs,), float(self.value()), device=view.device)


@dataclass(frozen=True, kw_only=True)
class Calling(Constant):
    """Asks what it was given."""

    ask: object = None

    def value(self):
        return self.ask()
