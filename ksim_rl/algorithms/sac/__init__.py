"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905) learns a policy with much entropy from a replay."""

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.wiring import make_off_policy_policy, make_off_policy_update
from ksim_rl.modules import QNetworkCfg, SquashedActorCfg
from ksim_rl.objectives import SACCfg
from ksim_rl.trainers.algorithm import Algorithm
from ksim_rl.trainers.run_cfg import ModulesCfg

SAC = Algorithm(
    name="sac",
    cfg=SACCfg,
    update=make_off_policy_update,
    policy=make_off_policy_policy,
    data=FEW_ENVS,
    on_ranks=True,
    modules=ModulesCfg(actor=SquashedActorCfg(), critic=QNetworkCfg()),
)
