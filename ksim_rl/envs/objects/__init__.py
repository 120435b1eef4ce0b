"""Passive things for `SceneCfg.objects`."""

from ksim_rl.envs.objects.box import Box

__all__ = ["Box"]
