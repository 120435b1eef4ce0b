"""Which algorithm an objective's config stands for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from ksim_rl.objectives import AMPCfg, DistillationCfg, PPOCfg, SACCfg, TD3Cfg
from ksim_rl.trainers.amp_update import make_amp_update
from ksim_rl.trainers.distillation_update import make_distillation_update
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
        resumed: the same as `update` for a run that goes on, where its parts come from the state that was saved.
    """

    update: Callable[[RunCfg, EnvBase], Update]
    policy: Callable[[RunCfg, EnvBase], TensorDictModuleBase]
    resumed: Callable[[RunCfg, EnvBase, Mapping[str, Any]], Update] | None = None


def _distillation(cfg: RunCfg, env: EnvBase, resumed: Mapping[str, Any] | None = None) -> Update:
    # A teacher may come from any algorithm, so its own needs the table of all.
    return make_distillation_update(cfg, env, resumed=resumed, make_policy=make_policy)


ALGORITHMS: dict[type[Any], Algorithm] = {
    PPOCfg: Algorithm(update=make_ppo_update, policy=make_ppo_policy),
    AMPCfg: Algorithm(update=make_amp_update, policy=make_ppo_policy),
    DistillationCfg: Algorithm(update=_distillation, policy=make_ppo_policy, resumed=_distillation),
    SACCfg: Algorithm(update=make_sac_update, policy=make_sac_policy),
    TD3Cfg: Algorithm(update=make_td3_update, policy=make_td3_policy),
}


def make_update(cfg: RunCfg, env: EnvBase, *, resumed: Mapping[str, Any] | None = None) -> Update:
    """Build the algorithm of a run, with all its memory allocated.

    Args:
        cfg: of the run.
        env: that it learns in.
        resumed: the `state_dict` of the update that goes on, which is not loaded here; None begins anew.
    """
    algorithm = ALGORITHMS[type(cfg.objective)]
    if resumed is not None and algorithm.resumed is not None:
        return algorithm.resumed(cfg, env, resumed)
    return algorithm.update(cfg, env)


def make_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModuleBase:
    """Build the policy of a run, and nothing else of it."""
    return ALGORITHMS[type(cfg.objective)].policy(cfg, env)
