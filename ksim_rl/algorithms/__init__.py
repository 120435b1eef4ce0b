"""The algorithms: each is a folder with its settings, wiring, update and defaults, found by name."""

from ksim_rl.algorithms.off_policy.update import OffPolicyUpdate
from ksim_rl.algorithms.ppo.update import PPOUpdate
from ksim_rl.algorithms.registry import algorithm, names, register
from ksim_rl.trainers.algorithm import Algorithm, Update

__all__ = ["Algorithm", "OffPolicyUpdate", "PPOUpdate", "Update", "algorithm", "names", "register"]
