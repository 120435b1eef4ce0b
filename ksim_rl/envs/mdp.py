"""This door leads from `ksim_rl.envs.mdp` to the room of terms, `ksim_rl.mdp`."""

from ksim_rl.mdp import *  # noqa: F403
from ksim_rl.mdp import __all__ as __all__
