"""Actor and critic of a run, made for what its env observes and does."""

from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.envs import EnvBase

from ksim_rl.modules import make_actor, make_critic
from ksim_rl.trainers.run_cfg import RunCfg


def build_networks(cfg: RunCfg, env: EnvBase) -> tuple[ProbabilisticTensorDictSequential, TensorDictModule]:
    """Build actor and critic for the observation groups and actions of an env."""
    device = cfg.resolved_device()
    spec: Any = env.observation_spec
    actor = make_actor(
        cfg.modules.actor,
        obs_dim=spec["actor"].shape[-1],
        action_dim=env.action_spec.shape[-1],
        action_spec=env.action_spec,
        device=device,
    )
    critic = make_critic(cfg.modules.critic, obs_dim=spec["critic"].shape[-1], device=device)
    return actor, critic
