"""A door: the term library is the room `ksim_rl.mdp`."""

from ksim_rl.mdp import *  # noqa: F403
from ksim_rl.mdp import __all__ as __all__
