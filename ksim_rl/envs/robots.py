"""This door leads from `ksim_rl.envs.robots` to `ksim_rl.scene.robots`."""

from ksim_rl.scene.robots import *  # noqa: F403
from ksim_rl.scene.robots import __all__ as __all__
