"""This module builds what the off-policy algorithms share: critics, the update, and checks of the config's parts."""

from typing import Any

from jaxtyping import Float
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl.algorithms.off_policy.update import OffPolicyUpdate
from ksim_rl.data import ReplayCfg
from ksim_rl.modules import ExploringPolicy, QNetworkCfg, make_q_network
from ksim_rl.objectives import OffPolicyLoss
from ksim_rl.trainers.run_cfg import RunCfg


def make_off_policy_update(cfg: RunCfg, loss: OffPolicyLoss, behavior: ExploringPolicy) -> OffPolicyUpdate:
    """Build the update of a run around its loss and the policy that collects."""
    objective: Any = cfg.objective
    data = of_kind(cfg.data, ReplayCfg, "data", cfg)
    return OffPolicyUpdate(
        objective,
        loss=loss,
        behavior=behavior,
        data=data,
        num_envs=cfg.num_envs,
        device=cfg.resolved_device(),
    )


def make_critic(cfg: RunCfg, env: EnvBase) -> TensorDictModule:
    """Build the action value networks of a run."""
    spec: Any = env.observation_spec
    return make_q_network(
        of_kind(cfg.modules.critic, QNetworkCfg, "modules.critic", cfg),
        obs_dim=spec["critic"].shape[-1],
        action_dim=env.action_spec.shape[-1],
        device=cfg.resolved_device(),
    )


def actor_sizes(cfg: RunCfg, env: EnvBase) -> dict[str, Any]:
    """Return what an actor of a run has to know of its env, as keyword arguments."""
    spec: Any = env.observation_spec
    return {
        "obs_dim": spec["actor"].shape[-1],
        "action_spec": env.action_spec,
        "device": cfg.resolved_device(),
    }


def action_bounds(actor: Any) -> tuple[Float[Tensor, " A"], Float[Tensor, " A"]]:
    """Return the lowest and highest action of a policy, the tensors that it uses itself."""
    policy = next(module for module in actor.modules() if hasattr(module, "low"))
    return policy.low, policy.high


def of_kind(value: Any, kind: type[Any], where: str, cfg: RunCfg) -> Any:
    """Return `value`, a part of the config, or refuse one of another class than the algorithm needs."""
    if not isinstance(value, kind):
        raise ValueError(
            f"{where} is a {type(value).__name__}, and {type(cfg.objective).__name__} needs a {kind.__name__}: "
            "the choice of objective=... brings what fits"
        )
    return value
