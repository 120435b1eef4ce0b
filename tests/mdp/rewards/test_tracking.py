import math

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import Plateau

HALF = math.sqrt(0.5)
YAW_90 = (HALF, 0.0, 0.0, HALF)


def test_linear_tracking_compares_in_the_roots_frame(free_body):
    # Heading along world y at 1 m/s, climbing at 0.2 m/s.
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(0, 1, 0.2, 0, 0, 0, 0, 0))
    free_body.command([[1.0, 0.0, 5.0], [0.0, 1.0, 5.0], [0.7, -0.4, 5.0]])
    value = free_body.read(mdp.TrackLinearVelocity(command="twist", std=0.5), "rewards/x")
    squared = torch.tensor([0.0, 1.0 + 1.0, 0.09 + 0.16]) + 0.04
    torch.testing.assert_close(value, torch.exp(-squared / 0.25), atol=1e-5, rtol=0)


def test_angular_tracking_punishes_roll_and_pitch_rates(free_body):
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(0, 0, 0, 0.3, 0.4, 0.5, 0, 0))
    free_body.command([[9.0, 9.0, 0.5], [9.0, 9.0, -0.5], [9.0, 9.0, 0.0]])
    value = free_body.read(
        mdp.TrackAngularVelocity(command="twist", std=math.sqrt(0.5)), "rewards/x"
    )
    squared = torch.tensor([0.0, 1.0, 0.25]) + 0.25
    torch.testing.assert_close(value, torch.exp(-squared / 0.5), atol=1e-5, rtol=0)


@pytest.mark.parametrize("std", [0.0, -1.0, float("nan")])
def test_std_must_be_positive(std):
    with pytest.raises(ValueError, match="std"):
        mdp.TrackLinearVelocity(command="twist", std=std)


def check(bench, term, expected):
    value = bench.read(term, "rewards/x")
    torch.testing.assert_close(value, torch.as_tensor(expected).expand_as(value), atol=1e-5, rtol=0)


def test_height_tracking_is_above_the_ground(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    free_body.driver.readings.commands["height"] = torch.tensor([[1.0], [0.8], [0.65]])
    term = mdp.TrackRootHeight(command="height", std=0.2)
    check(free_body, term, torch.exp(-torch.tensor([0.0, 1.0, (0.35 / 0.2) ** 2])))
    free_body.driver.ground = Plateau(3, free_body.view.device)
    # A quantity is computed once in each state.
    free_body.driver.forget()
    check(free_body, term, torch.exp(-torch.tensor([(0.25 / 0.2) ** 2, (0.05 / 0.2) ** 2, 0.25])))


def test_position_tracking_in_both_frames(free_body):
    # At (1, 2, 3), turned to the left. The left foot hangs 0.4 m below the hip, 0.2 m to the left: at (0.8, 2, 2.6).
    free_body.place(qpos=(1, 2, 3, *YAW_90, 0, 0))
    free_body.driver.readings.commands["reach"] = torch.tensor(
        [[0.0, 0.2, -0.4], [0.3, 0.2, -0.4], [0.8, 2.0, 2.6]]
    )
    own = mdp.TrackPosition(command="reach", std=0.3, site="left_foot")
    assert free_body.read(own, "rewards/x")[:2].tolist() == pytest.approx(
        [1.0, math.exp(-1.0)], abs=1e-5
    )
    world = mdp.TrackPosition(command="reach", std=0.3, site="left_foot", frame="world")
    assert free_body.read(world, "rewards/x")[2].item() == pytest.approx(1.0, abs=1e-5)
    hip = mdp.TrackPosition(command="reach", std=0.4, body="left")
    assert free_body.read(hip, "rewards/x")[0].item() == pytest.approx(math.exp(-1.0), abs=1e-5)
    with pytest.raises(ValueError, match="name exactly one"):
        mdp.TrackPosition(command="reach", std=0.3)


def test_orientation_tracking_takes_the_angle(free_body):
    # The left leg is turned by 0.5 rad about the root's y axis, and the root by 90 degrees to the left.
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0.5, 0))
    turned, opposite = (
        (math.cos(0.1), 0.0, math.sin(0.1), 0.0),
        (-math.cos(0.25), 0.0, -math.sin(0.25), 0.0),
    )
    targets = [(1.0, 0.0, 0.0, 0.0), turned, opposite]
    free_body.driver.readings.commands["pose"] = torch.tensor(
        [(9.0, 9.0, 9.0, *quat) for quat in targets]
    )
    own = mdp.TrackOrientation(command="pose", std=0.5, body="left")
    check(free_body, own, torch.exp(-torch.tensor([1.0, 0.36, 0.0])))
    world = mdp.TrackOrientation(command="pose", std=0.5, body="trunk", frame="world")
    assert free_body.read(world, "rewards/x")[0].item() == pytest.approx(
        math.exp(-(math.pi**2)), abs=1e-5
    )
    free_body.driver.readings.commands["pose"] = torch.zeros(3, 3)
    with pytest.raises(ValueError, match="'pose' has 3 numbers"):
        free_body.read(own, "rewards/x")


def test_joint_tracking_takes_the_mean_error(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.3, 0.7))
    free_body.driver.readings.commands["joints"] = torch.tensor(
        [[0.7, 0.3], [0.7, 0.7], [0.3, 0.3]]
    )
    term = mdp.TrackJointPosition(command="joints", std=0.2, joints=("right_hip", "left_hip"))
    check(free_body, term, torch.exp(-torch.tensor([0.0, 2.0, 2.0])))
