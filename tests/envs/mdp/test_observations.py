import math

import pytest
import torch

from ksim_rl.envs import mdp
from ksim_rl.envs.sensors import ContactSensor

HALF = math.sqrt(0.5)
YAW_90 = (HALF, 0.0, 0.0, HALF)
ROLL_90 = (HALF, HALF, 0.0, 0.0)


def close(value, expected, atol=1e-5):
    torch.testing.assert_close(
        value, torch.as_tensor(expected).expand_as(value).to(value.dtype), atol=atol, rtol=0
    )


def test_root_velocities_are_in_the_roots_frame(free_body):
    # A free joint's linear velocity is that of the frame's origin in the world; the angular one is in the body.
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(1, 0, 0, 0.1, 0.2, 0.3, 0, 0))
    close(free_body.read(mdp.RootLinVel()), [0.0, -1.0, 0.0])
    close(free_body.read(mdp.RootAngVel()), [0.1, 0.2, 0.3])
    close(free_body.read(mdp.RootPos()), [0.0, 0.0, 1.0])
    close(free_body.read(mdp.RootQuat()), YAW_90)


def test_velocimeter_reads_the_velocity_of_its_site(free_body):
    free_body.place(qpos=(0, 0, 1, *YAW_90, 0, 0), qvel=(1, 0, 0, 0, 0, 2, 0, 0))
    # v + w x r in the body frame, with r = (0.3, 0, 0) and w = (0, 0, 2)
    close(free_body.read(mdp.SensorReading(sensor="velocimeter")), [0.0, -1.0 + 0.6, 0.0])
    close(free_body.read(mdp.SensorReading(sensor="gyro")), [0.0, 0.0, 2.0])


def test_projected_gravity_points_down_in_the_roots_frame(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0, 0))
    close(free_body.read(mdp.ProjectedGravity()), [0.0, 0.0, -1.0])
    free_body.place(qpos=(0, 0, 1, *ROLL_90, 0, 0))
    close(free_body.read(mdp.ProjectedGravity()), [0.0, -1.0, 0.0])


def test_joints_come_in_the_order_that_is_asked_for(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.7, 0.9), qvel=(0, 0, 0, 0, 0, 0, 3, 4))
    close(free_body.read(mdp.JointPos()), [0.7, 0.9])
    close(free_body.read(mdp.JointPos(joints=("right_hip", "left_hip"))), [0.9, 0.7])
    close(free_body.read(mdp.JointVel(joints="right.*")), [4.0])
    close(free_body.read(mdp.JointPosRel()), [0.7 - 0.25, 0.9 - 0.5])


def test_encoder_bias_reaches_biased_readings_only(free_body):
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, 0.25, 0.5))
    free_body.view.encoder_bias_EL.copy_(torch.tensor([0.01, -0.02]).expand(3, 2))
    close(free_body.read(mdp.JointPosRel(biased=True)), [0.01, -0.02])
    close(free_body.read(mdp.JointPosRel()), [0.0, 0.0])
    close(free_body.read(mdp.JointPos()), [0.25, 0.5])


def test_foot_height_follows_the_leg(free_body):
    angle = 0.6
    free_body.place(qpos=(0, 0, 1, 1, 0, 0, 0, angle, 0))
    height = free_body.read(mdp.FootHeight(sites=("left_foot", "right_foot")))
    close(height, [1.0 - 0.4 * math.cos(angle), 0.6])


def test_action_and_command_pass_through(free_body):
    free_body.view.action_EL = torch.arange(6.0).view(3, 2)
    free_body.command([0.1, 0.2, 0.3])
    close(free_body.read(mdp.LastAction()), free_body.view.action_EL)
    close(free_body.read(mdp.Command(command="twist")), [0.1, 0.2, 0.3])


def test_contact_terms_of_resting_and_lifted_boxes(boxes):
    at_rest = (0, 0, 0.1, 1, 0, 0, 0, 1, 0, 0.1, 1, 0, 0, 0)
    lifted = (0, 0, 0.1, 1, 0, 0, 0, 1, 0, 0.9, 1, 0, 0, 0)
    boxes.place(qpos=[at_rest, lifted])
    for _ in range(20):
        boxes.step()
    contact = boxes.read(mdp.FootContact(sensor="touch"))
    close(contact, [[1.0, 1.0], [1.0, 0.0]])
    close(boxes.read(mdp.FootAirTime(sensor="touch")), [[0.0, 0.0], [0.0, 0.4]])
    # A box at rest presses on the ground with its weight: 3 kg and 1 kg at 10 m/s^2.
    force = boxes.read(mdp.FootContactForces(sensor="touch")).view(2, 2, 3)
    close(force[0, :, 2], [-math.log(31.0), -math.log(11.0)], atol=0.02)
    close(force[1, :, 2], [-math.log(31.0), 0.0], atol=0.02)
    close(force[..., :2], 0.0, atol=0.02)


def test_contact_forces_keep_their_sign(make_bench):
    bench = make_bench(BLOCK_UNDER_CEILING, 1, {"touch": ContactSensor(geoms=("a",), body="ceiling")})
    for _ in range(20):
        bench.step()
    force = bench.read(mdp.FootContactForces(sensor="touch"))
    close(force, [[0.0, 0.0, math.log(31.0)]], atol=0.02)


def test_unknown_names_list_the_near_ones(free_body):
    with pytest.raises(ValueError, match=r"left_hop.*left_hip"):
        free_body.read(mdp.JointPos(joints="left_hop"))
    with pytest.raises(ValueError, match=r"gyroo.*gyro"):
        free_body.read(mdp.SensorReading(sensor="gyroo"))


BLOCK_UNDER_CEILING = """
<mujoco>
  <option timestep="0.002" gravity="0 0 10"/>
  <worldbody>
    <body name="ceiling"><geom type="plane" size="0 0 0.01" pos="0 0 1" zaxis="0 0 -1"/></body>
    <body pos="0 0 0.9"><freejoint/><geom name="a" type="box" size="0.1 0.1 0.1" mass="3"/></body>
  </worldbody>
</mujoco>
"""
