"""Twin delayed deterministic policy gradients (Fujimoto et al., arXiv 1802.09477) learn from a replay."""

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.wiring import make_off_policy_policy, make_off_policy_update
from ksim_rl.modules import DeterministicActorCfg, QNetworkCfg
from ksim_rl.objectives import TD3Cfg
from ksim_rl.trainers.algorithm import Algorithm
from ksim_rl.trainers.run_cfg import ModulesCfg

TD3 = Algorithm(
    name="td3",
    cfg=TD3Cfg,
    update=make_off_policy_update,
    policy=make_off_policy_policy,
    data=FEW_ENVS,
    on_ranks=True,
    modules=ModulesCfg(actor=DeterministicActorCfg(hidden_dims=(256, 256)), critic=QNetworkCfg()),
)
