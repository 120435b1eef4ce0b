"""PPO with an adversarial motion prior (Peng et al., arXiv 2104.02180) is also rewarded for the style of motions."""

from ksim_rl.algorithms import ppo
from ksim_rl.algorithms.amp.update import make_amp_update
from ksim_rl.objectives import AMPCfg
from ksim_rl.trainers.algorithm import Algorithm

AMP = Algorithm(
    name="amp", cfg=AMPCfg, update=make_amp_update, policy=ppo.make_ppo_policy, data=ppo.DATA, on_ranks=True
)
