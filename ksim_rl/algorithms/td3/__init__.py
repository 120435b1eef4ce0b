"""Twin delayed deterministic policy gradients (Fujimoto et al., arXiv 1802.09477) learn from a replay."""

from ksim_rl.algorithms.off_policy import FEW_ENVS
from ksim_rl.algorithms.off_policy.wiring import off_policy_algorithm
from ksim_rl.modules import DeterministicActorCfg, QNetworkCfg
from ksim_rl.objectives import TD3Cfg

ACTOR = DeterministicActorCfg(hidden_dims=(256, 256))
TD3 = off_policy_algorithm("td3", TD3Cfg, data=FEW_ENVS, actor=ACTOR, critic=QNetworkCfg())
