import math

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.testing import count_syncs
from tests.envs.probe_env import DT, Target, puck_env, push
from tests.mdp.recorder import Recorder

AXES = {"vx": (-1.0, 1.0), "wz": (-0.5, 0.25)}


@pytest.fixture
def env():
    commands = {
        "stick": mdp.JoystickCommand(axes=AXES),
        "target": Target(resampling_time_range_s=(DT, DT)),
    }
    return puck_env(limit=None, commands=commands, episode_length_s=3 * DT)


def stick_after_step(env, root_E):
    return push(env, root_E)["next", "command", "stick"]


def test_it_is_zero_until_it_is_set_and_then_stays_over_resets(env):
    root_E = env.reset()
    assert root_E["command", "stick"].eq(0.0).all()
    env.command_manager.set("stick", [0.75, -0.25])
    assert root_E["command", "stick"].eq(0.0).all(), (
        "what the policy has seen does not change behind its back"
    )
    assert stick_after_step(env, root_E).tolist() == [[0.75, -0.25]] * 3
    assert env.reset()["command", "stick"].tolist() == [[0.75, -0.25]] * 3


def test_it_is_set_for_some_envs_and_clamped_by_axis(env):
    root_E = env.reset()
    env.command_manager.set("stick", torch.tensor([[5.0, 5.0], [0.5, -5.0], [0.1, 0.2]]))
    env.command_manager.set("stick", (0.0, 0.125), env_ids=[2])
    assert stick_after_step(env, root_E).tolist() == [[1.0, 0.25], [0.5, -0.5], [0.0, 0.125]]


def test_a_step_with_a_stick_never_makes_the_host_wait(env):
    root_E = env.reset()
    with count_syncs() as syncs:
        stick_after_step(env, root_E)
    assert syncs.total == 0, syncs.report()


def test_it_says_where_the_stick_is(env):
    env.reset()
    env.command_manager.set("stick", [0.5, -9.0])
    recorder = Recorder()
    with env.driver.scope("commands/stick"):
        env.cfg.commands["stick"].draw_debug(env.view, recorder, 1)
    assert [(kind, what[-1]) for kind, *what in recorder.drawn] == [("text", "vx +0.50, wz -0.50")]


def test_it_has_no_clock(env):
    env.reset()
    assert env.command_manager.time_left("stick").tolist() == [math.inf] * 3


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("stik", [0.0, 0.0], "unknown command 'stik': did you mean 'stick'"),
        ("target", [0.0], "a Target draws its values; a JoystickCommand takes them"),
        ("stick", [0.0], r"values of shape \(1,\): expected \[2\], the axes \['vx', 'wz'\]"),
        ("stick", [[0.0, 0.0]] * 2, r"values of shape \(2, 2\): expected .* or \[3, 2\]"),
        ("stick", [0.0, math.nan], "not finite"),
    ],
)
def test_what_cannot_be_set_is_refused(env, name, values, message):
    with pytest.raises(ValueError, match=message):
        env.command_manager.set(name, values)


def test_envs_that_do_not_exist_are_refused(env):
    with pytest.raises(ValueError, match=r"env_ids holds \[-1, 3\]: valid rows are 0 to 2"):
        env.command_manager.set("stick", [0.0, 0.0], env_ids=[-1, 3])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"axes": {}}, r"axes=\{\}"),
        ({"axes": {"vx": (1.0, -1.0)}}, r"axes\.vx"),
        (
            {"axes": AXES, "resampling_time_range_s": (1.0, 2.0)},
            "resampling_time_range_s=.*never drawn",
        ),
    ],
)
def test_what_makes_no_stick_is_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        mdp.JoystickCommand(**fields)
