"""PPO with an adversarial motion prior (Peng et al., arXiv 2104.02180) is also rewarded for the style of motions."""

from ksim_rl.algorithms.amp.update import make_amp_update
from ksim_rl.algorithms.ppo import ON_POLICY
from ksim_rl.objectives import AMPCfg

AMP = ON_POLICY(name="amp", cfg=AMPCfg, update=make_amp_update)
