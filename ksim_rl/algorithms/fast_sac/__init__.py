"""FastSAC (Seo et al., arXiv 2512.01996) is SAC with many envs, large minibatches and distributional critics."""

from dataclasses import dataclass

from ksim_rl.algorithms.off_policy import MANY_ENVS
from ksim_rl.algorithms.off_policy.wiring import OFF_POLICY
from ksim_rl.modules import QNetworkCfg, SquashedActorCfg
from ksim_rl.objectives import SACCfg
from ksim_rl.trainers.run_cfg import ModulesCfg


@dataclass(frozen=True, kw_only=True)
class FastSACCfg(SACCfg):
    """The settings of SAC, with the defaults of FastSAC."""

    gamma: float = 0.97
    tau: float = 0.125
    value_reduction: str = "mean"
    policy_delay: int = 4
    alpha_init: float = 1e-3
    target_entropy_per_action: float = 0.0
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 1e-3


ACTOR = SquashedActorCfg(
    hidden_dims=(512, 256, 128), activation="silu", layer_norm=True, log_std_max=0.0
)
CRITIC = QNetworkCfg(
    hidden_dims=(768, 384, 192),
    activation="silu",
    layer_norm=True,
    num_atoms=101,
    v_min=-20.0,
    v_max=20.0,
)
MODULES = ModulesCfg(actor=ACTOR, critic=CRITIC)
FAST_SAC = OFF_POLICY(name="fast_sac", cfg=FastSACCfg, data=MANY_ENVS, modules=MODULES)
