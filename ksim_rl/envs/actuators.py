"""This door leads from `ksim_rl.envs.actuators` to `ksim_rl.scene.actuators`."""

from ksim_rl.scene.actuators import *  # noqa: F403
from ksim_rl.scene.actuators import __all__ as __all__
