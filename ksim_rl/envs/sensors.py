"""This door leads from `ksim_rl.envs.sensors` to `ksim_rl.scene.sensors`."""

from ksim_rl.scene.sensors import *  # noqa: F403
from ksim_rl.scene.sensors import __all__ as __all__
