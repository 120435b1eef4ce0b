"""Collects rollouts `["E","T"]` with a policy in an env."""

from ksim_rl.collectors.rollout_collector import CollectorCfg, RolloutCollector

__all__ = ["CollectorCfg", "RolloutCollector"]
