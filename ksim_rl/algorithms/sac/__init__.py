"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905) learns a policy with much entropy from a replay."""

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.wiring import OFF_POLICY
from ksim_rl.modules import QNetworkCfg, SquashedActorCfg
from ksim_rl.objectives import SACCfg
from ksim_rl.trainers.run_cfg import ModulesCfg

MODULES = ModulesCfg(actor=SquashedActorCfg(), critic=QNetworkCfg())
SAC = OFF_POLICY(name="sac", cfg=SACCfg, data=FEW_ENVS, modules=MODULES)
