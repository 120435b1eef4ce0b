"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905) learns a policy with much entropy from a replay."""

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.wiring import off_policy_algorithm
from ksim_rl.modules import QNetworkCfg, SquashedActorCfg
from ksim_rl.objectives import SACCfg

SAC = off_policy_algorithm("sac", SACCfg, data=FEW_ENVS, actor=SquashedActorCfg(), critic=QNetworkCfg())
