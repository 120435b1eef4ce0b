"""Twin delayed deterministic policy gradients (Fujimoto et al., arXiv 1802.09477) learn from a replay."""

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.wiring import OFF_POLICY
from ksim_rl.modules import DeterministicActorCfg, QNetworkCfg
from ksim_rl.objectives import TD3Cfg
from ksim_rl.trainers.run_cfg import ModulesCfg

ACTOR = DeterministicActorCfg(hidden_dims=(256, 256))
MODULES = ModulesCfg(actor=ACTOR, critic=QNetworkCfg())
TD3 = OFF_POLICY(name="td3", cfg=TD3Cfg, data=FEW_ENVS, modules=MODULES)
