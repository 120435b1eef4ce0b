"""Twin delayed deterministic policy gradients (Fujimoto et al., arXiv 1802.09477) learn from a replay."""

from typing import Any

from tensordict.nn import TensorDictModule
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
from ksim_rl.modules import DeterministicActorCfg, ExploringPolicy, QNetworkCfg, make_deterministic_actor
from ksim_rl.objectives import TD3Cfg, TD3Loss
from ksim_rl.trainers.algorithm import Algorithm
from ksim_rl.trainers.run_cfg import ModulesCfg, RunCfg


def make_td3_update(cfg: RunCfg, env: EnvBase, resumed: object = None) -> OffPolicyUpdate:
    """Build the TD3 (or FastTD3) update of a run."""
    objective: Any = cfg.objective
    assert isinstance(objective, TD3Cfg)
    actor, critic = make_td3_policy(cfg, env), make_critic(cfg, env)
    low, high = action_bounds(actor)
    loss = TD3Loss(
        actor,
        critic,
        low_L=low,
        high_L=high,
        target_noise=objective.target_noise,
        target_noise_clip=objective.target_noise_clip,
        support_A=critic.module.support,  # type: ignore[arg-type]
        gamma=objective.gamma,
        value_reduction=objective.value_reduction,
    )
    behavior = ExploringPolicy(
        actor,
        low_L=low,
        high_L=high,
        num_envs=cfg.num_envs,
        noise_min=objective.exploration_noise_min,
        noise_max=objective.exploration_noise_max,
    )
    return make_off_policy_update(cfg, loss, behavior)


def make_td3_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModule:
    """Build the policy of a run with TD3."""
    actor = of_kind(cfg.modules.actor, DeterministicActorCfg, "modules.actor", cfg)
    return make_deterministic_actor(actor, **actor_sizes(cfg, env))


TD3 = Algorithm(
    name="td3",
    cfg=TD3Cfg,
    update=make_td3_update,
    policy=make_td3_policy,
    data=FEW_ENVS,
    modules=ModulesCfg(actor=DeterministicActorCfg(hidden_dims=(256, 256)), critic=QNetworkCfg()),
)
