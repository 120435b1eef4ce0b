"""Proximal policy optimization (Schulman et al., arXiv 1707.06347) learns from each rollout, for some epochs."""

from ksim_rl.algorithms.ppo.wiring import make_ppo_policy, make_ppo_update
from ksim_rl.data import DatasetCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers.algorithm import Algorithm

DATA = DatasetCfg(num_env_states_per_minibatch=4096, num_minibatches=4)
PPO = Algorithm(
    name="ppo", cfg=PPOCfg, update=make_ppo_update, policy=make_ppo_policy, data=DATA, on_ranks=True
)
