import math

import pytest
import torch

from ksim_rl import mdp
from ksim_rl.scene.state.ground import Ground
from tests.mdp.bench import Plateau


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


def test_root_height_counts_from_the_ground_below(free_body):
    free_body.place(qpos=[(0, 0, z, 1, 0, 0, 0, 0, 0) for z in (0.1, 0.55, 0.45)])
    free_body.driver.ground = Plateau(3, free_body.view.device)
    value = free_body.read(mdp.RootHeightBelow(minimum_height=0.25), "terminations/x")
    assert value.tolist() == [True, False, True]


def test_far_is_horizontal_and_from_where_the_env_starts(free_body):
    free_body.place(
        qpos=[
            (3, 4, 0, 1, 0, 0, 0, 0, 0),
            (0, 4.9, 9, 1, 0, 0, 0, 0, 0),
            (-5.1, 0, 0, 1, 0, 0, 0, 0, 0),
        ]
    )
    term = mdp.FarFromOrigin(distance=4.99)
    assert free_body.read(term, "terminations/x").tolist() == [True, False, True]
    free_body.driver.ground = Elsewhere(3, free_body.view.device)
    assert free_body.read(term, "terminations/x").tolist() == [False, False, True]


class Elsewhere(Ground):
    """Ground on which envs start at (1, 2)."""

    is_flat = False

    @property
    def origins_E3(self):
        return torch.tensor([1.0, 2.0, 0.0]).expand(3, 3)


def test_velocities_above_a_limit(free_body):
    # The trunk is turned, so that frames show; speeds are 5 m/s and 13 rad/s in any frame.
    half = math.pi / 4
    pose = (0, 0, 1, math.cos(half), 0, 0, math.sin(half), 0, 0)
    free_body.place(
        qpos=pose,
        qvel=[(3, 0, 4, 0, 0, 0, 0, 0), (0, 0, 0, 5, 12, 0, 0, 0), (0, 0, 0, 0, 0, 0, -9, 2)],
    )

    def ends(term):
        return free_body.read(term, "terminations/x").tolist()

    assert ends(mdp.RootVelocityAbove(linear=4.9)) == [True, False, False]
    assert ends(mdp.RootVelocityAbove(linear=5.1)) == [False] * 3
    assert ends(mdp.RootVelocityAbove(angular=12.9)) == [False, True, False]
    assert ends(mdp.RootVelocityAbove(linear=4.9, angular=12.9)) == [True, True, False]
    assert ends(mdp.JointVelocityAbove(limit=8.9)) == [False, False, True]
    assert ends(mdp.JointVelocityAbove(limit=3.0, joints="right_hip")) == [False] * 3


def test_joint_limits_are_the_soft_ones_with_a_margin(free_body):
    # Soft limits are (-0.5, 0.5) and (0.5, 1.5).
    joints = ((0.55, 1.0), (0.0, 0.35), (0.5, 1.5))
    free_body.place(qpos=[(0, 0, 1, 1, 0, 0, 0, *pair) for pair in joints])
    for margin, expected in (
        (0.0, [True, True, False]),
        (0.1, [False, True, False]),
        (0.2, [False] * 3),
    ):
        value = free_body.read(mdp.JointLimitViolated(margin=margin), "terminations/x")
        assert value.tolist() == expected
    left = mdp.JointLimitViolated(joints="left_hip")
    assert free_body.read(left, "terminations/x").tolist() == [True, False, False]


def test_a_contact_is_illegal_above_its_force(boxes):
    boxes.place(qpos=(0, 0, 0.1, 1, 0, 0, 0, 1, 0, 5.0, 1, 0, 0, 0), qvel=0.0)
    boxes.step(100)  # box a rests with its weight of 30 N
    for threshold, ends in ((0.0, True), (29.0, True), (31.0, False)):
        value = boxes.read(
            mdp.IllegalContact(sensor="touch", threshold=threshold), "terminations/x"
        )
        assert value.tolist() == [ends] * 2
    boxes.place(qpos=(0, 0, 5.0, 1, 0, 0, 0, 1, 0, 5.0, 1, 0, 0, 0), qvel=0.0)
    boxes.step(5)
    assert not boxes.read(mdp.IllegalContact(sensor="touch"), "terminations/x").any()


def test_what_is_not_finite_beyond_positions_and_velocities(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0), qvel=0.0)
    free_body.step(1)
    term = mdp.NonFiniteState()
    assert not free_body.read(term, "terminations/x").any()
    free_body.world.sensordata_EL[1, 0] = torch.inf
    free_body.world.qacc_EL[2, 5] = torch.nan
    assert free_body.read(term, "terminations/x").tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mdp.FarFromOrigin(distance=0.0), r"distance=0\.0"),
        (lambda: mdp.RootVelocityAbove(), "linear=None, angular=None"),
        (lambda: mdp.RootVelocityAbove(linear=-1.0), r"linear=-1\.0"),
        (lambda: mdp.JointVelocityAbove(limit=0.0), r"limit=0\.0"),
        (lambda: mdp.JointLimitViolated(margin=-0.1), r"margin=-0\.1"),
        (lambda: mdp.IllegalContact(sensor="touch", threshold=math.nan), "threshold=nan"),
        (lambda: mdp.RootHeightBelow(minimum_height=math.inf), "minimum_height=inf"),
    ],
)
def test_limits_are_checked(make, message):
    with pytest.raises(ValueError, match=message):
        make()
