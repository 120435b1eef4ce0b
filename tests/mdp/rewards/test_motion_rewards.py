import math

import pytest
import torch

from ksim_rl import mdp

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


def check(bench, term, expected, atol=1e-5):
    value = bench.read(term, "rewards/x")
    torch.testing.assert_close(
        value, torch.as_tensor(expected).expand_as(value), atol=atol, rtol=1e-5
    )


def test_off_axis_velocities_are_the_roots_own(free_body):
    # Lying on its side: the world's -y is the body's z, and the spin about world z is one about body y.
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0), qvel=(7, 2, 3, 0.3, 0.4, 9, 0, 0))
    check(free_body, mdp.LinVelZL2(), 4.0)
    check(free_body, mdp.AngVelXYL2(), 0.25)


def test_body_angular_velocity_is_taken_in_the_world_frame(free_body):
    # Lying on its side, the trunk spins about its own z axis, which is horizontal.
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0), qvel=(0, 0, 0, 0, 0, 2, 0, 0))
    check(free_body, mdp.BodyAngularVelocity(body="trunk"), 4.0, atol=1e-4)
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0), qvel=(0, 0, 0, 0, 2, 0, 0, 0))
    check(free_body, mdp.BodyAngularVelocity(body="trunk"), 0.0, atol=1e-4)


def test_angular_momentum_is_about_the_centre_of_mass(make_bench):
    bench = make_bench(SPINNER, 2)
    # The frame's origin moves so that the centre of mass, 0.5 m away, rests: only the spin is left.
    bench.place(qpos=(0, 0, 0, 1, 0, 0, 0), qvel=(0, -1.0, 0, 0, 0, 2.0))
    check(bench, mdp.AngularMomentum(sensor="angmom"), (0.04 * 2.0) ** 2, atol=1e-6)


def test_links_of_a_falling_body_accelerate_with_gravity(free_body):
    term = mdp.LinkAccelerationL2(bodies=("trunk", "right"))
    free_body.place(qpos=(0, 0, 9, 1, 0, 0, 0, 0, 0), qvel=(1, 2, 3, 0, 0, 0, 0, 0))
    free_body.world.ctrl_EL.zero_()
    free_body.step()
    check(free_body, term, 0.0)
    free_body.step()
    check(free_body, term, 2 * 9.81**2, atol=0.05)
    # After a reset there is no earlier velocity to compare with.
    reset = torch.tensor([False, True, False])
    free_body.view.buffers.clear(reset)
    free_body.view.episode_step_E.masked_fill_(reset, 0)
    free_body.step()
    check(free_body, term, [2 * 9.81**2, 0.0, 2 * 9.81**2], atol=0.05)


def test_the_jerk_of_links_is_the_change_of_their_acceleration(free_body):
    # The root's velocity is (t^2, 0, 0) in env steps, and "right" moves with it.
    term = mdp.LinkJerkL2(bodies=("trunk", "right"))
    for step in range(1, 5):
        free_body.view.episode_step_E.fill_(step)
        free_body.place(qpos=(0, 0, 9, 1, 0, 0, 0, 0, 0), qvel=(step**2, 0, 0, 0, 0, 0, 0, 0))
        expected = 0.0 if step <= 2 else 2 * (2.0 / 0.02**2) ** 2
        value = free_body.read(term, "rewards/jerk")
        torch.testing.assert_close(value, torch.full((3,), expected), rtol=1e-4, atol=1e-3)


def test_joints_may_move_unless_the_command_is_to_stand(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0), qvel=(0, 0, 0, 0, 0, 0, 3, -4))
    free_body.command([[0.0, 0.0, 0.0], [0.03, 0.0, -0.02], [0.0, 0.04, 0.02]])
    term = mdp.MotionlessAtRest(command="twist", command_threshold=0.051)
    check(free_body, term, [25.0, 25.0, 0.0])
    right = mdp.MotionlessAtRest(command="twist", command_threshold=0.051, joints="right_hip")
    check(free_body, right, [16.0, 16.0, 0.0])
    with pytest.raises(ValueError, match="command_threshold=-1"):
        mdp.MotionlessAtRest(command="twist", command_threshold=-1)
