"""Where the columns of an action end up, and what happens to them on the way."""

import math

import pytest
import torch

from ksim_rl import mdp
from tests.mdp.bench import Bench

ARMS = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0"/>
      <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0"/>
        <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
        <body name="hand" pos="0 0 -0.3">
          <joint name="wrist" axis="0 1 0"/>
          <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
          <body name="finger" pos="0 0 -0.1">
            <joint name="grip" type="slide"/>
            <joint name="loose" type="slide" axis="1 0 0"/>
            <geom type="sphere" size="0.1" mass="1" contype="0" conaffinity="0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="grip" joint="grip" ctrllimited="true" ctrlrange="-2 3" gear="4"/>
    <velocity name="wrist" joint="wrist" kv="2"/>
    <position name="elbow" joint="elbow" kp="10"/>
    <position name="shoulder" joint="shoulder" kp="10"/>
    <velocity name="elbow_brake" joint="elbow" kv="3"/>
  </actuator>
  <keyframe><key name="rest" qpos="0.25 0.5 0 0 0"/></keyframe>
</mujoco>
"""
"""A chain of servos, whose actuators stand in another order than its joints."""

GRIP, WRIST, ELBOW, SHOULDER, BRAKE = range(5)
ACTION = torch.tensor([[1.0, 2.0], [0.0, 0.0], [-1.0, 0.5]])


@pytest.fixture(scope="module")
def arms():
    return Bench(ARMS, 3, {})


def run(bench, term, action=ACTION, scope="actions/x"):
    with bench.driver.scope(scope):
        term(bench.view, action)
    return bench.world.ctrl_EL


def test_position_targets_reach_the_servos_of_their_joints(arms):
    term = mdp.JointPositionAction(joints=("shoulder", "elbow"), scale=0.5)
    ctrl = run(arms, term)
    torch.testing.assert_close(ctrl[:, SHOULDER], 0.25 + 0.5 * ACTION[:, 0])
    torch.testing.assert_close(ctrl[:, ELBOW], 0.5 + 0.5 * ACTION[:, 1])
    torch.testing.assert_close(arms.view.joint_pos_target_EL[:, :2], ctrl[:, [SHOULDER, ELBOW]])
    assert term.size(arms.view) == 2


def test_columns_follow_the_order_of_the_term(arms):
    ctrl = run(
        arms, mdp.JointPositionAction(joints=("elbow", "shoulder"), use_default_offset=False)
    )
    torch.testing.assert_close(ctrl[:, [ELBOW, SHOULDER]], ACTION)


def test_a_relative_position_starts_where_the_joint_is(arms):
    arms.place(qpos=[0.1, -0.2, 0.0, 0.0, 0.0])
    ctrl = run(arms, mdp.RelativeJointPositionAction(joints=("elbow", "shoulder"), scale=0.1))
    torch.testing.assert_close(ctrl[:, ELBOW], -0.2 + 0.1 * ACTION[:, 0])
    torch.testing.assert_close(ctrl[:, SHOULDER], 0.1 + 0.1 * ACTION[:, 1])


def test_velocities_reach_velocity_servos(arms):
    ctrl = run(arms, mdp.JointVelocityAction(joints="wrist", scale=3.0, offset=0.5), ACTION[:, :1])
    torch.testing.assert_close(ctrl[:, WRIST], 0.5 + 3.0 * ACTION[:, 0])
    torch.testing.assert_close(arms.view.joint_vel_target_EL[:, 2], ctrl[:, WRIST])


def test_a_joint_with_two_servos_takes_position_and_velocity(arms):
    term = mdp.JointPositionVelocityAction(joints="elbow", scale=0.1, velocity_scale=2.0)
    assert term.size(arms.view) == 2
    ctrl = run(arms, term)
    torch.testing.assert_close(ctrl[:, ELBOW], 0.5 + 0.1 * ACTION[:, 0])
    torch.testing.assert_close(ctrl[:, BRAKE], 2.0 * ACTION[:, 1])


def test_scale_and_offset_by_joint_and_clip_before_scaling(arms):
    term = mdp.JointPositionAction(
        joints=("shoulder", "elbow"),
        scale={"sh.*": 2.0, "el.*": 3.0},
        offset={"sh.*": 0.0, "el.*": 10.0},
        use_default_offset=False,
        clip=(-0.5, 1.0),
    )
    ctrl = run(arms, term)
    torch.testing.assert_close(ctrl[:, SHOULDER], torch.tensor([2.0, 0.0, -1.0]))
    torch.testing.assert_close(ctrl[:, ELBOW], torch.tensor([13.0, 10.0, 11.5]))


def test_tanh_squashes_after_the_clip(arms):
    term = mdp.JointVelocityAction(joints="wrist", scale=5.0, tanh=True, clip=(-0.5, 9.0))
    ctrl = run(arms, term, ACTION[:, :1])
    expected = [5.0 * math.tanh(1.0), 0.0, 5.0 * math.tanh(-0.5)]
    torch.testing.assert_close(ctrl[:, WRIST], torch.tensor(expected))


def test_the_filter_answers_a_step_like_a_first_order_system(arms):
    """A continuous low-pass with corner f answers a unit step by 1 - exp(-2 pi f t)."""
    term = mdp.JointVelocityAction(joints="wrist", scale=3.0, offset=1.0, cutoff_hz=4.0)
    one = torch.ones(3, 1)
    answers = [run(arms, term, one, scope="actions/filtered")[:, WRIST].clone() for _ in range(6)]
    for steps, answer in enumerate(answers, start=1):
        expected = 1.0 + 3.0 * (1.0 - math.exp(-2.0 * math.pi * 4.0 * steps * arms.view.step_dt))
        torch.testing.assert_close(answer, torch.full((3,), expected))
    arms.view.buffers.clear(torch.tensor([False, True, False]))
    after = run(arms, term, 0.0 * one, scope="actions/filtered")[:, WRIST]
    assert after[1] == 1.0, "no action at all"
    assert after[0] == after[2] > 1.0


def test_some_joints_leave_the_other_controls_alone(arms):
    arms.world.ctrl_EL.fill_(7.0)
    ctrl = run(
        arms, mdp.JointPositionAction(joints="elbow", use_default_offset=False), ACTION[:, :1]
    )
    torch.testing.assert_close(ctrl[:, ELBOW], ACTION[:, 0])
    assert (ctrl[:, [GRIP, WRIST, SHOULDER, BRAKE]] == 7.0).all()


def test_effort_stays_in_the_control_range(arms):
    ctrl = run(arms, mdp.JointEffortAction(joints="grip", scale=5.0), ACTION[:, :1])
    torch.testing.assert_close(ctrl[:, GRIP], torch.tensor([3.0, 0.0, -2.0]))
    torch.testing.assert_close(arms.view.joint_effort_target_EL[:, 3], ctrl[:, GRIP])


def test_controls_as_they_are_stay_in_their_ranges(arms):
    term = mdp.ActuatorAction(actuators=("shoulder", "grip"), scale=5.0)
    ctrl = run(arms, term, ACTION)
    torch.testing.assert_close(ctrl[:, SHOULDER], 5.0 * ACTION[:, 0])
    torch.testing.assert_close(ctrl[:, GRIP], torch.tensor([3.0, 0.0, 2.5]))
    assert term.size(arms.view) == 2


TENDONS = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <worldbody>
    <body name="slider">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.1" mass="2"/>
      <site name="hook" euler="0 0 90"/>
    </body>
  </worldbody>
  <tendon><fixed name="cord"><joint joint="slide" coef="2"/></fixed></tendon>
  <actuator>
    <position name="cord" tendon="cord" kp="10" kv="5"/>
    <motor name="thrust" site="hook" gear="0 -3 0 0 0 0"/>
  </actuator>
</mujoco>
"""


def test_tendons_and_sites_take_controls_with_scale_and_offset_by_name():
    bench = Bench(TENDONS, 3, {})
    term = mdp.ActuatorAction(
        actuators=("thrust", "cord"),
        scale={"cord": 0.5, "thrust": 2.0},
        offset={"cord": 0.3, "thrust": 0.0},
    )
    ctrl = run(bench, term)
    torch.testing.assert_close(
        ctrl, torch.stack((0.5 * ACTION[:, 1] + 0.3, 2.0 * ACTION[:, 0]), dim=-1)
    )
    # The site's y axis points against x: a force of 3 per unit of control, against the gear's sign, on 2 kg.
    bench.place(qpos=[[0.0]], qvel=[[0.0]])
    run(bench, mdp.ActuatorAction(actuators="thrust"), ACTION[:, :1])
    bench.world.ctrl_EL[:, 0] = 0.0
    bench.step(1)
    torch.testing.assert_close(
        bench.world.qvel_EL[:, 0], 3.0 * ACTION[:, 0] / 2.0 * 0.002, atol=1e-5, rtol=1e-2
    )
    # Alone, the cord comes to rest where its length, twice the slide's position, is the control.
    run(bench, mdp.ActuatorAction(actuators="cord", offset=0.4), 0.0 * ACTION[:, :1])
    bench.world.ctrl_EL[:, 1] = 0.0
    for _ in range(400):
        bench.step()
    torch.testing.assert_close(bench.world.qpos_EL[:, 0], torch.full((3,), 0.2), atol=1e-3, rtol=0)
    with pytest.raises(ValueError, match="scale: pattern 'thrust' matches nothing"):
        run(bench, mdp.ActuatorAction(actuators="cord", scale={"thrust": 1.0}))


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (mdp.JointPositionAction(joints="grip"), "'grip' is asked for a position.*takes an effort"),
        (
            mdp.JointEffortAction(joints="shoulder"),
            "'shoulder' is asked for an effort.*takes a position",
        ),
        (
            mdp.JointVelocityAction(joints="shoulder"),
            "'shoulder' is asked for a velocity.*takes a position",
        ),
        (
            mdp.JointPositionAction(joints="wrist"),
            "'wrist' is asked for a position.*takes a velocity",
        ),
    ],
)
def test_an_actuator_that_takes_another_kind_of_target_refuses(arms, term, message):
    with pytest.raises(ValueError, match=message):
        run(arms, term, ACTION[:, :1])


def test_a_joint_without_actuator_is_named(arms):
    with pytest.raises(ValueError, match="no actuator drives joint 'loose'"):
        run(arms, mdp.JointEffortAction(joints="loose"), ACTION[:, :1])


def test_scale_must_name_each_joint(arms):
    with pytest.raises(ValueError, match=r"scale.*shoulder"):
        run(arms, mdp.JointPositionAction(joints=("elbow", "shoulder"), scale={"elbow": 1.0}))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"scale": math.nan}, "scale"),
        ({"offset": {"elbow": math.inf}}, r"offset\.elbow=inf"),
        ({"clip": (1.0, -1.0)}, "clip"),
        ({"cutoff_hz": 0.0}, "cutoff_hz"),
    ],
)
def test_numbers_are_checked(fields, message):
    with pytest.raises(ValueError, match=message):
        mdp.JointPositionAction(joints="elbow", **fields)


def bounds(bench, term):
    with bench.driver.scope("actions/bounds"):
        found_K2 = term.bounds(bench.view)
    return None if found_K2 is None else found_K2.tolist()


def test_bounds_are_the_actions_that_reach_the_control_range(arms):
    effort = mdp.JointEffortAction(joints="grip")
    assert bounds(arms, effort) == [[-2.0, 3.0]]
    assert bounds(arms, mdp.JointEffortAction(joints="grip", scale=-2.0, offset=1.0)) == [
        [-1.0, 1.5]
    ]
    assert bounds(arms, mdp.JointEffortAction(joints="grip", clip=(-1.0, 5.0))) == [[-1.0, 3.0]]
    assert bounds(arms, mdp.JointEffortAction(joints="grip", tanh=True)) is None
    assert bounds(arms, mdp.ActuatorAction(actuators=("grip", "wrist"), scale=0.5)) == [
        [-4.0, 6.0],
        [-math.inf, math.inf],
    ]
    assert bounds(arms, mdp.ActuatorAction(actuators="grip", scale=-1.0, offset=0.5)) == [
        [-2.5, 2.5]
    ]
    servos = mdp.JointPositionVelocityAction(joints="elbow", clip=(-1.0, 2.0))
    assert bounds(arms, servos) == [[-1.0, 2.0]] * 2
    assert bounds(arms, mdp.JointPositionAction(joints="elbow")) is None
