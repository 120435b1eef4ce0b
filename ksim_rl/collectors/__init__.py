"""This room collects rollouts `["E","T"]` with a policy in an env."""

from ksim_rl.collectors.collector_cfg import CollectorCfg
from ksim_rl.collectors.rollout_collector import RolloutCollector

__all__ = ["CollectorCfg", "RolloutCollector"]
