"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905) learns a policy with much entropy from a replay."""

from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs import EnvBase

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.update import OffPolicyUpdate
from ksim_rl.algorithms.off_policy.wiring import (
    action_bounds,
    actor_sizes,
    make_critic,
    make_off_policy_update,
    of_kind,
)
from ksim_rl.modules import ExploringPolicy, QNetworkCfg, SquashedActorCfg, make_squashed_actor
from ksim_rl.objectives import SACCfg, SACLoss
from ksim_rl.trainers.algorithm import Algorithm
from ksim_rl.trainers.run_cfg import ModulesCfg, RunCfg


def make_sac_update(cfg: RunCfg, env: EnvBase, resumed: object = None) -> OffPolicyUpdate:
    """Build the SAC (or FastSAC) update of a run."""
    objective: Any = cfg.objective
    assert isinstance(objective, SACCfg)
    actor, critic = make_sac_policy(cfg, env), make_critic(cfg, env)
    low, high = action_bounds(actor)
    # The entropy of actions that are scaled from [-1, 1] differs by the logarithm of that scale.
    entropy = len(low) * objective.target_entropy_per_action + float(((high - low) / 2).log().sum())
    loss = SACLoss(
        actor,
        critic,
        target_entropy=entropy,
        alpha_init=objective.alpha_init,
        learn_alpha=objective.alpha_learning_rate > 0.0,
        support_A=critic.module.support,  # type: ignore[arg-type]
        gamma=objective.gamma,
        value_reduction=objective.value_reduction,
    )
    return make_off_policy_update(
        cfg, loss, ExploringPolicy(actor, low_L=low, high_L=high, num_envs=cfg.num_envs)
    )


def make_sac_policy(cfg: RunCfg, env: EnvBase) -> ProbabilisticTensorDictSequential:
    """Build the policy of a run with SAC."""
    actor = of_kind(cfg.modules.actor, SquashedActorCfg, "modules.actor", cfg)
    return make_squashed_actor(actor, **actor_sizes(cfg, env))


SAC = Algorithm(
    name="sac",
    cfg=SACCfg,
    update=make_sac_update,
    policy=make_sac_policy,
    data=FEW_ENVS,
    modules=ModulesCfg(actor=SquashedActorCfg(), critic=QNetworkCfg()),
)
