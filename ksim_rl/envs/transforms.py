"""This door leads from `ksim_rl.envs.transforms` to the room `ksim_rl.transforms`."""

from ksim_rl.transforms import *  # noqa: F403
from ksim_rl.transforms import __all__ as __all__
