import math

import pytest
import torch

from ksim_rl import mdp

HALF = math.sqrt(0.5)
YAW_90 = (HALF, 0.0, 0.0, HALF)
ROLL_90 = (HALF, HALF, 0.0, 0.0)
UPRIGHT = (0, 0, 1, 1, 0, 0, 0, 0, 0)

ROBOT_AND_CUBE = """
<mujoco>
  <worldbody>
    <body name="robot/base" pos="0 0 1"><freejoint/><geom size="0.1" mass="1"/></body>
    <body name="cube/box" pos="2 0 1"><freejoint/><geom size="0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


def close(value, expected, atol=1e-5):
    torch.testing.assert_close(
        value, torch.as_tensor(expected).expand_as(value).to(value.dtype), atol=atol, rtol=0
    )


def test_root_velocities_in_the_roots_and_in_the_worlds_axes(free_body):
    # A free joint's linear velocity is the velocity of the frame's origin in the world; the angular one is in the body.
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(1, 0, 0, 0.1, 0.2, 0.3, 0, 0))
    close(free_body.read(mdp.RootLinVel()), [0.0, -1.0, 0.0])
    close(free_body.read(mdp.RootLinVel(frame="world")), [1.0, 0.0, 0.0])
    close(free_body.read(mdp.RootAngVel()), [0.1, 0.2, 0.3])
    close(free_body.read(mdp.RootAngVel(frame="world")), [-0.2, 0.1, 0.3])
    with pytest.raises(ValueError, match="frame='body'.*root"):
        mdp.RootLinVel(frame="body")


def test_root_pose(free_body):
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0))
    close(free_body.read(mdp.RootPos()), [0.0, 0.0, 1.0])
    close(free_body.read(mdp.RootQuat()), YAW_90)
    close(free_body.read(mdp.RootRotation6d()), [0.0, 1.0, 0.0, -1.0, 0.0, 0.0])


def test_root_terms_read_the_entity_that_is_named(make_bench):
    bench = make_bench(ROBOT_AND_CUBE, 1, entities=("robot", "cube"))
    bench.place(
        qpos=(0, 0, 1, 1, 0, 0, 0, 2, 0, 1, *YAW_90), qvel=(1, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 4)
    )
    close(bench.read(mdp.RootPos(entity="cube")), [2.0, 0.0, 1.0])
    close(bench.read(mdp.RootQuat(entity="cube")), YAW_90)
    close(bench.read(mdp.RootRotation6d(entity="cube")), [0.0, 1.0, 0.0, -1.0, 0.0, 0.0])
    close(bench.read(mdp.RootLinVel(entity="cube")), [3.0, 0.0, 0.0])
    close(bench.read(mdp.RootAngVel(entity="cube")), [0.0, 0.0, 4.0])
    close(bench.read(mdp.RootLinVel()), bench.read(mdp.RootLinVel(entity="robot")))
    # The cube stands 2 m before the robot; the robot, 2 m on the cube's right.
    close(bench.read(mdp.BodyPos(bodies="cube/box")), [2.0, 0.0, 0.0])
    close(bench.read(mdp.BodyPos(bodies="robot/base", entity="cube")), [0.0, 2.0, 0.0])
    with pytest.raises(ValueError, match="cubes.*cube"):
        bench.read(mdp.RootPos(entity="cubes"))


def test_velocimeter_reads_the_velocity_of_its_site(free_body):
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(1, 0, 0, 0, 0, 2, 0, 0))
    # v + w x r in the body frame, with r = (0.3, 0, 0) and w = (0, 0, 2)
    close(free_body.read(mdp.SensorReading(sensor="velocimeter")), [0.0, -1.0 + 0.6, 0.0])
    close(free_body.read(mdp.SensorReading(sensor="gyro")), [0.0, 0.0, 2.0])


def test_projected_gravity_points_down_in_the_roots_frame(free_body):
    free_body.place(qpos=UPRIGHT)
    close(free_body.read(mdp.ProjectedGravity()), [0.0, 0.0, -1.0])
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0))
    close(free_body.read(mdp.ProjectedGravity()), [0.0, -1.0, 0.0])


def test_lagging_gravity_answers_a_step_exponentially(free_body):
    term, tau = mdp.ProjectedGravity(time_constant=0.05), 0.05
    free_body.place(qpos=UPRIGHT)
    close(free_body.read(term), [0.0, 0.0, -1.0])
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0))
    # The env reads each term once per step (tests/envs/test_buffers_advance.py).
    for k in (1, 2, 3):
        free_body.view.episode_step_E.add_(1)
        left = math.exp(-k * 0.02 / tau)
        blend = torch.tensor([0.0, left - 1.0, -left])
        close(free_body.read(term), blend / blend.norm())
    # A reset fills the filter of its row with the new orientation, and leaves the others alone.
    reset = torch.tensor([True, False, False])
    free_body.view.buffers.clear(reset)
    free_body.view.episode_step_E.masked_fill_(reset, 0)
    reading = free_body.read(term)
    close(reading[0], [0.0, -1.0, 0.0])
    left = math.exp(-4 * 0.02 / tau)
    blend = torch.tensor([0.0, left - 1.0, -left])
    close(reading[1:], blend / blend.norm())
    with pytest.raises(ValueError, match="time_constant=-1"):
        mdp.ProjectedGravity(time_constant=-1)


def test_action_and_command_pass_through(free_body):
    free_body.driver.readings.action_EL = torch.arange(6.0).view(3, 2)
    free_body.command([0.1, 0.2, 0.3])
    close(free_body.read(mdp.LastAction()), free_body.view.action_EL)
    close(free_body.read(mdp.Command(command="twist")), [0.1, 0.2, 0.3])


def test_unknown_names_list_the_near_ones(free_body):
    with pytest.raises(ValueError, match=r"left_hop.*left_hip"):
        free_body.read(mdp.JointPos(joints="left_hop"))
    with pytest.raises(ValueError, match=r"gyroo.*gyro"):
        free_body.read(mdp.SensorReading(sensor="gyroo"))
