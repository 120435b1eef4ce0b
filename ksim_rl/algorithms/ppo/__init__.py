"""Proximal policy optimization (Schulman et al., arXiv 1707.06347) learns from each rollout, for some epochs."""

from functools import partial

from ksim_rl.algorithms.ppo.wiring import make_ppo_policy, make_ppo_update
from ksim_rl.data import DatasetCfg
from ksim_rl.objectives import PPOCfg
from ksim_rl.trainers.algorithm import Algorithm

DATA = DatasetCfg(num_env_states_per_minibatch=4096, num_minibatches=4)
ON_POLICY = partial(Algorithm, policy=make_ppo_policy, data=DATA, on_ranks=True)
"""Makes an algorithm with PPO's policy and data from its name, settings and update."""
PPO = ON_POLICY(name="ppo", cfg=PPOCfg, update=make_ppo_update)
