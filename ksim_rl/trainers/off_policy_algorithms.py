"""SAC and TD3 for a run: networks, loss and update, made for what its env observes and does."""

from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.data import ReplayCfg
from ksim_rl.modules import (
    DeterministicActorCfg,
    ExploringPolicy,
    QNetworkCfg,
    SquashedActorCfg,
    make_deterministic_actor,
    make_q_network,
    make_squashed_actor,
)
from ksim_rl.objectives import OffPolicyLoss, SACCfg, SACLoss, TD3Cfg, TD3Loss
from ksim_rl.trainers.off_policy_update import OffPolicyUpdate
from ksim_rl.trainers.run_cfg import RunCfg


def make_sac_update(cfg: RunCfg, env: EnvBase) -> OffPolicyUpdate:
    """Build the SAC (or FastSAC) update of a run."""
    objective: Any = cfg.objective
    assert isinstance(objective, SACCfg)
    actor, critic = make_sac_policy(cfg, env), _critic(cfg, env)
    low, high = _bounds(actor)
    # The entropy of actions that are scaled from [-1, 1] differs by the logarithm of that scale.
    entropy = len(low) * objective.target_entropy_per_action + float(((high - low) / 2).log().sum())
    loss = SACLoss(
        actor,
        critic,
        target_entropy=entropy,
        alpha_init=objective.alpha_init,
        learn_alpha=objective.alpha_learning_rate > 0.0,
        support=critic.module.support,  # type: ignore[arg-type]
        gamma=objective.gamma,
        value_reduction=objective.value_reduction,
    )
    return _update(cfg, loss, ExploringPolicy(actor, low=low, high=high, num_envs=cfg.num_envs))


def make_td3_update(cfg: RunCfg, env: EnvBase) -> OffPolicyUpdate:
    """Build the TD3 (or FastTD3) update of a run."""
    objective: Any = cfg.objective
    assert isinstance(objective, TD3Cfg)
    actor, critic = make_td3_policy(cfg, env), _critic(cfg, env)
    low, high = _bounds(actor)
    loss = TD3Loss(
        actor,
        critic,
        low=low,
        high=high,
        target_noise=objective.target_noise,
        target_noise_clip=objective.target_noise_clip,
        support=critic.module.support,  # type: ignore[arg-type]
        gamma=objective.gamma,
        value_reduction=objective.value_reduction,
    )
    behavior = ExploringPolicy(
        actor,
        low=low,
        high=high,
        num_envs=cfg.num_envs,
        noise_min=objective.exploration_noise_min,
        noise_max=objective.exploration_noise_max,
    )
    return _update(cfg, loss, behavior)


def make_sac_policy(cfg: RunCfg, env: EnvBase) -> ProbabilisticTensorDictSequential:
    """Build the policy of a run with SAC."""
    actor = _of_kind(cfg.modules.actor, SquashedActorCfg, "modules.actor", cfg)
    return make_squashed_actor(actor, **_actor_sizes(cfg, env))


def make_td3_policy(cfg: RunCfg, env: EnvBase) -> TensorDictModule:
    """Build the policy of a run with TD3."""
    actor = _of_kind(cfg.modules.actor, DeterministicActorCfg, "modules.actor", cfg)
    return make_deterministic_actor(actor, **_actor_sizes(cfg, env))


def _update(cfg: RunCfg, loss: OffPolicyLoss, behavior: ExploringPolicy) -> OffPolicyUpdate:
    objective: Any = cfg.objective
    data = _of_kind(cfg.data, ReplayCfg, "data", cfg)
    return OffPolicyUpdate(
        objective,
        loss=loss,
        behavior=behavior,
        data=data,
        num_envs=cfg.num_envs,
        device=cfg.resolved_device(),
    )


def _critic(cfg: RunCfg, env: EnvBase) -> TensorDictModule:
    spec: Any = env.observation_spec
    return make_q_network(
        _of_kind(cfg.modules.critic, QNetworkCfg, "modules.critic", cfg),
        obs_dim=spec["critic"].shape[-1],
        action_dim=env.action_spec.shape[-1],
        device=cfg.resolved_device(),
    )


def _actor_sizes(cfg: RunCfg, env: EnvBase) -> dict[str, Any]:
    spec: Any = env.observation_spec
    return {
        "obs_dim": spec["actor"].shape[-1],
        "action_spec": env.action_spec,
        "device": cfg.resolved_device(),
    }


def _bounds(actor: Any) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest action of a policy, the tensors that it uses itself."""
    policy = next(module for module in actor.modules() if hasattr(module, "low"))
    return policy.low, policy.high


def _of_kind(value: Any, kind: type[Any], where: str, cfg: RunCfg) -> Any:
    if not isinstance(value, kind):
        raise ValueError(
            f"{where} is a {type(value).__name__}, and {type(cfg.objective).__name__} needs a {kind.__name__}: "
            "objective=sac, fast_sac or fast_td3 chooses what fits"
        )
    return value
