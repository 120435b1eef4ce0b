"""Collectors: from an env and a policy to rollouts `["E","T"]`."""

from ksim_rl.collectors.collector_cfg import CollectorCfg
from ksim_rl.collectors.rollout_collector import RolloutCollector

__all__ = ["CollectorCfg", "RolloutCollector"]
