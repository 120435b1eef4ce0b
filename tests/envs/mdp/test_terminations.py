import math

import pytest
import torch

from ksim_rl.envs import mdp


@pytest.mark.parametrize("axis", [0, 1])
def test_orientation_is_bad_beyond_the_limit_in_any_direction(free_body, axis):
    rows = []
    for degrees in (-71.0, 69.0, 150.0):
        half = math.radians(degrees) / 2
        imaginary = [0.0, 0.0, 0.0]
        imaginary[axis] = math.sin(half)
        rows.append((0, 0, 1, math.cos(half), *imaginary, 0, 0))
    free_body.place(qpos=rows)
    term = mdp.BadOrientation(limit_angle=math.radians(70.0))
    assert free_body.read(term, "terminations/x").tolist() == [True, False, True]


def test_turning_is_no_bad_orientation(free_body):
    half = math.radians(150.0) / 2
    free_body.place(qpos=(0, 0, 1, math.cos(half), 0, 0, math.sin(half), 0, 0))
    assert not free_body.read(mdp.BadOrientation(limit_angle=0.1), "terminations/x").any()


def test_root_height(free_body):
    free_body.place(qpos=[(0, 0, z, 1, 0, 0, 0, 0, 0) for z in (0.1, 0.3, 0.2)])
    value = free_body.read(mdp.RootHeightBelow(minimum_height=0.25), "terminations/x")
    assert value.tolist() == [True, False, True]


def test_time_out_comes_with_the_last_step(free_body):
    free_body.view.max_episode_length = 10
    free_body.view.episode_step_E.copy_(torch.tensor([9, 10, 0]))
    assert free_body.read(mdp.TimeOut(), "terminations/x").tolist() == [False, True, False]
    assert mdp.TimeOut().time_out


@pytest.mark.parametrize("angle", [0.0, 4.0])
def test_limit_angle_is_checked(angle):
    with pytest.raises(ValueError, match="limit_angle"):
        mdp.BadOrientation(limit_angle=angle)
