import math

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import Plateau


def pose(**changes):
    return mdp.Pose(
        **{
            "command": "twist",
            "std_standing": {"left_hip": 0.1, "right_hip": 0.2},
            "std_walking": {".*_hip": 0.5},
            "std_running": {"left_.*": 1.0, "right_.*": 2.0},
            "walking_threshold": 0.05,
            "running_threshold": 1.5,
        }
        | changes
    )


@pytest.mark.parametrize("body", [None, "trunk"])
@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.2])
def test_upright_falls_with_the_sine_of_the_tilt(free_body, body, tilt):
    free_body.place(qpos=(0, 0, 1, math.cos(tilt / 2), 0, math.sin(tilt / 2), 0, 0, 0))
    value = free_body.read(mdp.Upright(std=0.4, body=body), "rewards/x")
    torch.testing.assert_close(
        value, torch.full((3,), math.exp(-((math.sin(tilt) / 0.4) ** 2))), atol=1e-5, rtol=0
    )


def test_upright_of_another_body_sees_its_joint(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.5, 0))
    left = free_body.read(mdp.Upright(std=1.0, body="left"), "rewards/x")
    trunk = free_body.read(mdp.Upright(std=1.0), "rewards/x")
    torch.testing.assert_close(
        left, torch.full((3,), math.exp(-(math.sin(0.5) ** 2))), atol=1e-5, rtol=0
    )
    torch.testing.assert_close(trunk, torch.ones(3))


def test_pose_tolerance_depends_on_the_commanded_speed(free_body):
    # Errors of 0.1 and 0.3 rad from the default pose (0.25, 0.5); speeds 0.04, 0.05 and 1.5.
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.35, 0.8))
    free_body.command([[0.03, 0.0, -0.01], [0.03, 0.04, 0.0], [0.0, 1.0, -0.5]])
    value = free_body.read(pose(), "rewards/x")
    standing = (1.0**2 + 1.5**2) / 2
    walking = (0.2**2 + 0.6**2) / 2
    running = (0.1**2 + 0.15**2) / 2
    expected = torch.exp(-torch.tensor([standing, walking, running]))
    torch.testing.assert_close(value, expected, atol=1e-5, rtol=0)


def test_pose_needs_one_std_for_each_joint(free_body):
    free_body.command([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"std_walking.*right_hip.*no pattern"):
        free_body.read(pose(std_walking={"left_hip": 0.1}), "rewards/x")
    with pytest.raises(ValueError, match=r"std_walking.*left_hip"):
        free_body.read(pose(std_walking={".*": 0.1, "left_hip": 0.2}), "rewards/x")
    with pytest.raises(ValueError, match=r"std_walking.*knee"):
        free_body.read(pose(std_walking={".*_hip": 0.1, "knee": 0.2}), "rewards/x")
    with pytest.raises(ValueError, match="std_running"):
        pose(std_running={".*": 0.0})
    with pytest.raises(ValueError, match="running_threshold"):
        pose(running_threshold=0.01)


@pytest.mark.parametrize("body", [None, "trunk"])
def test_tilt_is_the_squared_sine(free_body, body):
    # Rolled by 0.3 rad, then turned about the vertical, which does not matter.
    roll, yaw = 0.15, 0.5
    quat = (
        math.cos(yaw) * math.cos(roll),
        math.cos(yaw) * math.sin(roll),
        math.sin(yaw) * math.sin(roll),
        math.sin(yaw) * math.cos(roll),
    )
    free_body.place(qpos=(0, 0, 1, *quat, 0, 0))
    value = free_body.read(mdp.TiltL2(body=body), "rewards/x")
    torch.testing.assert_close(value, torch.full((3,), math.sin(0.3) ** 2), atol=1e-5, rtol=0)


@pytest.mark.parametrize("body", [None, "trunk"])
@pytest.mark.parametrize(("about", "axis"), [("roll", 1), ("pitch", 2)])
def test_tilt_about_one_axis_alone(free_body, body, about, axis):
    turns = {1: 0.3, 2: 0.2}
    quat = [math.cos(turns[axis] / 2), 0.0, 0.0, 0.0]
    quat[axis] = math.sin(turns[axis] / 2)
    free_body.place(qpos=(0, 0, 1, *quat, 0, 0), qvel=(0, 0, 0, 0.5, 0.7, 0.9, 0, 0))
    squared = math.sin(turns[axis]) ** 2
    other = "pitch" if about == "roll" else "roll"
    for wanted, expected in ((about, squared), (other, 0.0)):
        value = free_body.read(mdp.TiltL2(body=body, about=wanted), "rewards/x")
        torch.testing.assert_close(value, torch.full((3,), expected), atol=1e-5, rtol=0)
        upright = free_body.read(mdp.Upright(std=0.5, body=body, about=wanted), "rewards/x")
        torch.testing.assert_close(
            upright, torch.full((3,), math.exp(-expected / 0.25)), atol=1e-5, rtol=0
        )
    rate = free_body.read(mdp.AngVelXYL2(about=about), "rewards/x")
    torch.testing.assert_close(rate, torch.full((3,), (0.5, 0.7)[axis - 1] ** 2))


def test_a_root_height_inside_a_range_earns_one(free_body):
    term = mdp.RootHeightInside(height=(0.5, 0.8), margin=0.2)
    for height, expected in (
        (0.5, 1.0),
        (0.7, 1.0),
        (0.45, 0.75),
        (0.9, 0.5),
        (0.3, 0.0),
        (1.2, 0.0),
    ):
        free_body.place(qpos=(0, 0, height, 1, 0, 0, 0, 0, 0))
        torch.testing.assert_close(
            free_body.read(term, "rewards/x"), torch.full((3,), expected), atol=1e-5, rtol=0
        )


def test_root_height_is_above_the_ground(free_body):
    term = mdp.RootHeightL2(target_height=0.6)
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    torch.testing.assert_close(
        free_body.read(term, "rewards/x"), torch.full((3,), 0.16), atol=1e-5, rtol=0
    )
    free_body.driver.ground = Plateau(3, free_body.view.device)
    # A quantity is computed once in each state.
    free_body.driver.forget()
    torch.testing.assert_close(
        free_body.read(term, "rewards/x"), torch.full((3,), 0.15**2), atol=1e-5, rtol=0
    )
