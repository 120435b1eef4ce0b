"""An export tells the ranges of commands that its policy has seen, and nothing beyond reaches the policy."""

import numpy as np
import pytest

from ksim_rl import mdp
from ksim_rl.export.described_commands import described_commands
from ksim_rl.export.standalone.commands import CommandRange
from tests.envs.probe_env import puck_env_in_c

AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")


@pytest.fixture(scope="module")
def env():
    start, end = ({"height": pair} for pair in ((0.3, 0.3), (0.1, 0.5)))
    return puck_env_in_c(
        limit=None,
        commands={
            "twist": mdp.UniformVelocityCommand(
                resampling_time_range_s=None, **dict.fromkeys(AXES, (-1.0, 0.5))
            ),
            "height": mdp.BaseHeightCommand(resampling_time_range_s=None, height=(0.2, 0.4)),
            "start": mdp.StartPoseCommand(),
        },
        curriculum={
            "level": mdp.LinearLevel(end_step=10),
            "stages": mdp.CommandRangesByStage(
                command="twist", stages={12: {"lin_vel_x": (0.0, 2.0)}}
            ),
            "heights": mdp.CommandRangesByLevel(command="height", start=start, end=end),
        },
    )


@pytest.mark.parametrize(("step_count", "fastest"), [(11, 0.5), (12, 2.0)])
def test_ranges_of_stages_that_have_begun_are_seen(env, step_count, fastest):
    found = described_commands(env, env.cfg.curriculum.values(), step_count)
    assert found == {
        "twist": {
            "size": 3,
            "kind": "UniformVelocityCommand",
            "low": [-1.0, -1.0, -1.0],
            "high": [fastest, 0.5, 0.5],
        },
        # What follows a level may have been anything between its ends.
        "height": {"size": 1, "kind": "BaseHeightCommand", "low": [0.1], "high": [0.5]},
        "start": {"size": 7, "kind": "StartPoseCommand", "low": None, "high": None},
    }


SPEC = {"size": 2, "low": [-1.0, 0.0], "high": [1.0, 0.5]}


def test_a_command_beyond_its_range_is_clipped_or_refused():
    allowed = CommandRange("twist", SPEC)
    assert allowed.clip(np.array([3.0, 0.2])).tolist() == [1.0, 0.2]
    allowed.check(np.float32([1.0, 0.5]))
    for values in ([1.1, 0.2], [0.0, np.nan]):
        with pytest.raises(
            ValueError, match="expected -1 0 to 1 0.5: the policy has seen no others"
        ):
            allowed.check(np.array(values))
    with pytest.raises(ValueError, match="3 numbers: expected 2"):
        allowed.check(np.zeros(3))
    # A folder of before there were ranges takes what it always took.
    CommandRange("twist", {"size": 1}).check(np.array([1e6]))


@pytest.mark.parametrize(
    "change", [{"low": [0.0]}, {"low": "low"}, {"high": {}}, {"high": [1.0, None]}, {"low": [2, 0]}]
)
def test_ranges_that_are_none_are_refused(change):
    with pytest.raises(ValueError, match="commands.twist"):
        CommandRange("twist", {**SPEC, **change})
