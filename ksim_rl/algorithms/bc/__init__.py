"""Behavior cloning (Pomerleau, 1988) lets a policy act as recorded episodes do, in the states that these visit."""

from ksim_rl.algorithms.bc.update import make_bc_policy, make_bc_update
from ksim_rl.algorithms.ppo import DATA
from ksim_rl.objectives import BCCfg
from ksim_rl.trainers.algorithm import Algorithm

BC = Algorithm(name="bc", cfg=BCCfg, update=make_bc_update, policy=make_bc_policy, data=DATA)
