"""The term library: observations, commands, actions, rewards, terminations, events, curricula and metrics of tasks.

Each term of these modules is public. The bases that terms share are not: they do nothing when called, or are abstract,
or draw a field that they do not name.
"""

import inspect

from ksim_rl.mdp.actions import *  # noqa: F403
from ksim_rl.mdp.commands.gait import *  # noqa: F403
from ksim_rl.mdp.commands.joystick import *  # noqa: F403
from ksim_rl.mdp.commands.pose import *  # noqa: F403
from ksim_rl.mdp.commands.velocity import *  # noqa: F403
from ksim_rl.mdp.curricula import *  # noqa: F403
from ksim_rl.mdp.events import *  # noqa: F403
from ksim_rl.mdp.metrics import *  # noqa: F403
from ksim_rl.mdp.motion_tracking import *  # noqa: F403
from ksim_rl.mdp.observations.bodies import *  # noqa: F403
from ksim_rl.mdp.observations.robot import *  # noqa: F403
from ksim_rl.mdp.randomization.bodies import *  # noqa: F403
from ksim_rl.mdp.randomization.friction import *  # noqa: F403
from ksim_rl.mdp.randomization.joints import *  # noqa: F403
from ksim_rl.mdp.randomization.looks import *  # noqa: F403
from ksim_rl.mdp.randomization.poses import *  # noqa: F403
from ksim_rl.mdp.randomization.randomize import RandomizeField
from ksim_rl.mdp.randomization.shapes import *  # noqa: F403
from ksim_rl.mdp.rewards.feet import *  # noqa: F403
from ksim_rl.mdp.rewards.joints import *  # noqa: F403
from ksim_rl.mdp.rewards.tracking import *  # noqa: F403
from ksim_rl.mdp.steered_actions import *  # noqa: F403
from ksim_rl.mdp.task_space_actions import *  # noqa: F403
from ksim_rl.mdp.terminations import *  # noqa: F403


def _is_public(value: object) -> bool:
    if not isinstance(value, type) or not value.__module__.startswith(__name__):
        return False
    has_no_field = issubclass(value, RandomizeField) and not hasattr(value, "field")
    return "__call__" in dir(value) and not inspect.isabstract(value) and not has_no_field


__all__ = sorted(name for name, value in globals().items() if _is_public(value))  # pyright: ignore


def __dir__() -> list[str]:
    return __all__
