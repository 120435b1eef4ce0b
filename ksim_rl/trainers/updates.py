"""Which algorithm an objective's config stands for."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl.objectives import PPOCfg, SACCfg, TD3Cfg
from ksim_rl.trainers.off_policy_algorithms import (
    make_sac_policy,
    make_sac_update,
    make_td3_policy,
    make_td3_update,
)
from ksim_rl.trainers.ppo_update import make_ppo_policy, make_ppo_update
from ksim_rl.trainers.run_cfg import RunCfg
from ksim_rl.trainers.update import Update


@dataclass(frozen=True, kw_only=True)
class Algorithm:
    """How the parts of an algorithm are made for a run and its env.

    Attributes:
        update: everything that learns.
        policy: the policy alone, whose weights a checkpoint holds under `update/actor`.
    """

    update: Callable[[RunCfg, EnvBase], Update]
    policy: Callable[[RunCfg, EnvBase], TensorDictModuleBase]


ALGORITHMS: dict[type[Any], Algorithm] = {
    PPOCfg: Algorithm(update=make_ppo_update, policy=make_ppo_policy),
    SACCfg: Algorithm(update=make_sac_update, policy=make_sac_policy),
    TD3Cfg: Algorithm(update=make_td3_update, policy=make_td3_policy),
}


def make_update(cfg: RunCfg, env: EnvBase) -> Update:
    """Build the algorithm of a run, with all its memory allocated."""
    return ALGORITHMS[type(cfg.objective)].update(cfg, env)


def make_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a run, and nothing else of it."""
    return ALGORITHMS[type(cfg.objective)].policy(cfg, env)
