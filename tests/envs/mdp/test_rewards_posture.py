import math

import pytest
import torch

from ksim_rl.envs import mdp

HALF = math.sqrt(0.5)
ROLL_90 = (HALF, HALF, 0.0, 0.0)
SPINNER = """
<mujoco>
  <worldbody>
    <body name="wheel"><freejoint/><inertial pos="0.5 0 0" mass="2" diaginertia="0.02 0.03 0.04"/></body>
  </worldbody>
  <sensor><subtreeangmom name="angmom" body="wheel"/></sensor>
</mujoco>
"""


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
    torch.testing.assert_close(left, torch.full((3,), math.exp(-(math.sin(0.5) ** 2))), atol=1e-5, rtol=0)
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


def test_joint_limits_count_the_overshoot_of_the_soft_range(free_body):
    # Half of (-1, 1) is (-0.5, 0.5), half of (0, 2) is (0.5, 1.5).
    free_body.place(qpos=[(0, 0, 1, 1, 0, 0, 0, *angles) for angles in ((0.4, 1.4), (-0.7, 1.6), (0.8, 0.1))])
    value = free_body.read(mdp.JointPosLimits(), "rewards/x")
    torch.testing.assert_close(value, torch.tensor([0.0, 0.3, 0.7]), atol=1e-5, rtol=0)
    left = free_body.read(mdp.JointPosLimits(joints="left_hip"), "rewards/x")
    torch.testing.assert_close(left, torch.tensor([0.0, 0.2, 0.3]), atol=1e-5, rtol=0)


def test_body_angular_velocity_is_taken_in_the_world_frame(free_body):
    # Lying on its side, the trunk spins about its own z axis, which is horizontal.
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0), qvel=(0, 0, 0, 0, 0, 2, 0, 0))
    value = free_body.read(mdp.BodyAngularVelocity(body="trunk"), "rewards/x")
    torch.testing.assert_close(value, torch.full((3,), 4.0), atol=1e-4, rtol=0)
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0), qvel=(0, 0, 0, 0, 2, 0, 0, 0))
    value = free_body.read(mdp.BodyAngularVelocity(body="trunk"), "rewards/x")
    torch.testing.assert_close(value, torch.zeros(3), atol=1e-4, rtol=0)


def test_angular_momentum_is_about_the_centre_of_mass(make_bench):
    bench = make_bench(SPINNER, 2)
    # The frame's origin moves so that the centre of mass, 0.5 m away, rests: only the spin is left.
    bench.place(qpos=(0, 0, 0, 1, 0, 0, 0), qvel=(0, -1.0, 0, 0, 0, 2.0))
    value = bench.read(mdp.AngularMomentum(sensor="angmom"), "rewards/x")
    torch.testing.assert_close(value, torch.full((2,), (0.04 * 2.0) ** 2), atol=1e-6, rtol=0)
