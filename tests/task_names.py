"""The names of all tasks as parameters of tests: of a suite two are quick ones, the others run in full runs."""

import pytest

from ksim_rl import envs

# The tasks of a suite differ from each other in a few numbers.
QUICK = ("dm_control_ball_in_cup_catch", "playground_humanoid_walk")
NAMES = [
    pytest.param(name, marks=pytest.mark.full)
    if envs.task(name).suite and name not in QUICK
    else name
    for name in envs.names()
]
