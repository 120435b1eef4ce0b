"""Passive things for `SceneCfg.objects`."""

from ksim_rl.scene.objects.box import Box

__all__ = ["Box"]
