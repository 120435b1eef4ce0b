"""FastTD3 (Seo et al., arXiv 2505.22642) is TD3 with many envs, large minibatches and distributional critics."""

from dataclasses import dataclass

from ksim_rl.algorithms.off_policy import MANY_ENVS
from ksim_rl.algorithms.off_policy.wiring import OFF_POLICY
from ksim_rl.modules import DeterministicActorCfg, QNetworkCfg
from ksim_rl.objectives import TD3Cfg
from ksim_rl.trainers.run_cfg import ModulesCfg


@dataclass(frozen=True, kw_only=True)
class FastTD3Cfg(TD3Cfg):
    """The settings of TD3, with the defaults of FastTD3."""

    gamma: float = 0.97
    tau: float = 0.1
    exploration_noise_min: float = 0.001
    exploration_noise_max: float = 0.4
    target_noise: float = 0.001
    weight_decay: float = 0.1


ACTOR = DeterministicActorCfg()
CRITIC = QNetworkCfg(hidden_dims=(1024, 512, 256), num_atoms=101)
MODULES = ModulesCfg(actor=ACTOR, critic=CRITIC)
FAST_TD3 = OFF_POLICY(name="fast_td3", cfg=FastTD3Cfg, data=MANY_ENVS, modules=MODULES)
