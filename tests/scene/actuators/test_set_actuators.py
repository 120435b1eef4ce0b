"""Actuators in the compiled model, against MJCF written by hand."""

import math

import mujoco
import numpy as np
import pytest

from ksim_rl.envs import MjcfRobot
from ksim_rl.scene.actuators import (
    DCMotorActuator,
    DelayedActuator,
    IdealPDActuator,
    MotorActuator,
    PositionActuator,
    VelocityActuator,
    set_actuators,
)

BODY = """
<mujoco>
  <compiler angle="radian"/>
  <default>
    <general ctrllimited="true" ctrlrange="-9 9" gear="7" biastype="affine" biasprm="1 2 3"/>
    <joint damping="0.3" armature="0.01" frictionloss="0.2" actuatorfrcrange="-99 99"/>
    {defaults}
  </default>
  <worldbody>
    <body name="base">
      <freejoint/>
      <geom size="0.1"/>
      <body name="a"><joint name="a" range="-1 2" limited="true" {a}/><geom size="0.1"/></body>
      <body name="b"><joint name="b" {b}/><geom size="0.1"/></body>
      <body name="c"><joint name="c" type="slide" {c}/><geom size="0.1"/></body>
      <body name="d"><joint name="d" {d}/><geom size="0.1"/></body>
      <body name="ball"><joint name="ball" type="ball"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="cable"><joint joint="d" coef="1"/></fixed></tendon>
  <actuator>{actuators}</actuator>
  <sensor>{sensors}</sensor>
</mujoco>
"""
OWN = """
<motor name="old_a" joint="a" gear="3"/>
<general name="cable" tendon="cable" gear="2"/>
<motor name="old_d" joint="d"/>
"""
ROBOT = BODY.format(
    defaults="",
    a="",
    b="",
    c="",
    d="",
    actuators=OWN,
    sensors='<actuatorfrc name="torque" actuator="old_a"/>',
)
FIELDS = (
    "trntype",
    "trnid",
    "gaintype",
    "gainprm",
    "biastype",
    "biasprm",
    "dyntype",
    "dynprm",
    "gear",
    "ctrllimited",
    "forcelimited",
    "forcerange",
    "actlimited",
    "actrange",
)


def compiled(*actuators):
    return MjcfRobot(source=ROBOT, actuators=actuators).spec().compile()


def test_built_in_ones_compile_to_what_mjcf_of_their_own_says():
    model = compiled(
        PositionActuator(joints="a", stiffness=20.0, damping=1.5, effort_limit=6.0, armature=0.07),
        VelocityActuator(joints="b", damping=2.5, effort_limit=3.0, frictionloss=0.9),
        MotorActuator(joints="d", effort_limit=8.0),
    )
    plain = 'class="plain" ctrllimited="false"'
    by_hand = mujoco.MjModel.from_xml_string(
        BODY.format(
            defaults='<default class="plain"><general gear="1"/></default>',
            a='armature="0.07" actuatorfrclimited="false"',
            b='frictionloss="0.9" actuatorfrclimited="false"',
            c="",
            d='actuatorfrclimited="false"',
            actuators=f"""
              <general name="cable" tendon="cable" gear="2"/>
              <position name="a" joint="a" kp="20" kv="1.5" forcerange="-6 6" {plain}/>
              <velocity name="b" joint="b" kv="2.5" forcerange="-3 3" {plain}/>
              <motor name="d" joint="d" class="plain" ctrlrange="-8 8" forcerange="-8 8"/>""",
            sensors='<actuatorfrc name="torque" actuator="a"/>',
        )
    )
    names = [by_hand.actuator(i).name for i in range(by_hand.nu)]
    assert [model.actuator(i).name for i in range(model.nu)] == names == ["cable", "a", "b", "d"]
    for field in FIELDS:
        ours, theirs = (getattr(m, f"actuator_{field}") for m in (model, by_hand))
        np.testing.assert_array_equal(ours, theirs, err_msg=field)
    limited = by_hand.actuator_ctrllimited.astype(bool)
    np.testing.assert_array_equal(
        model.actuator_ctrlrange[limited], by_hand.actuator_ctrlrange[limited]
    )
    for field in (
        "dof_armature",
        "dof_frictionloss",
        "dof_damping",
        "jnt_actfrclimited",
        "sensor_objid",
    ):
        np.testing.assert_array_equal(getattr(model, field), getattr(by_hand, field), err_msg=field)
    assert model.sensor("torque").objid[0] == model.actuator("a").id


def test_explicit_ones_compile_to_plain_motors_that_nothing_else_clamps():
    pd = {"stiffness": 1.0, "damping": 1.0, "effort_limit": 6.0}
    model = compiled(
        IdealPDActuator(joints="b", armature=0.5, **pd),
        DelayedActuator(
            actuator=DCMotorActuator(joints="a", saturation_effort=9.0, velocity_limit=1.0, **pd),
            max_lag=2,
        ),
    )
    assert [model.actuator(i).name for i in range(model.nu)] == ["cable", "old_d", "b", "a"]
    for name in ("a", "b"):
        motor, joint = model.actuator(name), model.joint(name)
        assert motor.gainprm[0] == 1.0 and motor.gear[0] == 1.0 and not motor.biasprm.any()
        assert (
            not model.actuator_ctrllimited[motor.id] and not model.actuator_forcelimited[motor.id]
        )
        assert not model.jnt_actfrclimited[joint.id]
    assert model.dof_armature[model.joint("b").dofadr[0]] == 0.5
    assert model.dof_armature[model.joint("a").dofadr[0]] == 0.01
    assert model.jnt_actfrclimited[model.joint("c").id], (
        "a joint that nothing drives keeps its limit"
    )


def test_no_entries_leave_the_model_as_it_is():
    assert [compiled().actuator(i).name for i in range(3)] == ["old_a", "cable", "old_d"]


def test_a_joint_without_own_limit_keeps_that_of_the_model():
    model = compiled(PositionActuator(joints="a", stiffness=1.0))
    assert model.jnt_actfrclimited[model.joint("a").id]
    assert not model.actuator_forcelimited[model.actuator("a").id]


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        ((("a", "b"), "[bc]"), r"joint 'b' is driven by actuators\[0\] and actuators\[1\]"),
        (("a", "elbow.*"), r"no joint matches 'elbow\.\*'"),
        (("a", "ball"), "no joint matches 'ball'"),
        ((("a", "[ab]"),), "'a' is matched by two"),
    ],
)
def test_a_joint_with_two_entries_or_a_pattern_without_joint_is_named(patterns, message):
    with pytest.raises(ValueError, match=message):
        compiled(*(MotorActuator(joints=entry) for entry in patterns))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PositionActuator(joints="a", stiffness=0.0), "stiffness=0.0"),
        (lambda: PositionActuator(joints="a", stiffness=1.0, damping=-1.0), "damping=-1.0"),
        (lambda: VelocityActuator(joints="a", damping=math.nan), "damping=nan"),
        (lambda: MotorActuator(joints="a", effort_limit=0.0), "effort_limit=0.0"),
        (lambda: MotorActuator(joints="a", armature=-1.0), "armature=-1.0"),
        (
            lambda: DelayedActuator(actuator=MotorActuator(joints="a"), min_lag=3, max_lag=2),
            "min_lag=3 exceeds",
        ),
        (lambda: DelayedActuator(actuator=MotorActuator(joints="a"), max_lag=1.5), "max_lag=1.5"),
    ],
)
def test_numbers_are_checked(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_tuned_servo_oscillates_at_its_natural_frequency_and_damping():
    """Free response of q'' + 2 z w q' + w^2 q = 0 from rest; the light arm leaves only the armature."""
    light = """
    <mujoco>
      <option timestep="0.0001" integrator="RK4" gravity="0 0 0"/>
      <worldbody>
        <body>
          <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>
          <joint name="arm"/>
        </body>
      </worldbody>
    </mujoco>"""
    servo = PositionActuator.tuned(
        joints="arm", effort_limit=5.0, armature=1e-2, natural_frequency=2.0, damping_ratio=0.5
    )
    model = MjcfRobot(source=light, actuators=(servo,)).spec().compile()
    data = mujoco.MjData(model)
    start, seconds, angular = 0.1, 0.3, 2.0 * math.pi * 2.0
    data.qpos[0] = start
    for _ in range(round(seconds / 1e-4)):
        mujoco.mj_step(model, data)
    decay, damped = 0.5 * angular, angular * math.sqrt(1.0 - 0.5**2)
    swing = math.cos(damped * seconds) + decay / damped * math.sin(damped * seconds)
    assert data.qpos[0] == pytest.approx(start * math.exp(-decay * seconds) * swing, abs=2e-4)


def test_the_servos_control_range_says_what_can_still_change_the_effort():
    servo = PositionActuator(joints="a", stiffness=20.0, effort_limit=5.0)
    model = compiled(servo)
    index = model.actuator("a").id
    np.testing.assert_allclose(model.actuator_ctrlrange[index], [-1.0 - 0.25, 2.0 + 0.25])
    data = mujoco.MjData(model)
    data.ctrl[index] = 100.0
    mujoco.mj_forward(model, data)
    assert data.actuator_force[index] == 5.0, "the force is clamped, the target is not"


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_the_control_range_is_in_radians_and_metres_whatever_the_files_unit(angle):
    edge = 90.0 if angle == "degree" else math.radians(90.0)
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><compiler angle="{angle}"/><worldbody><body><geom size="0.1"/>
        <joint name="hinge" range="{-edge} {edge}"/><joint name="slide" type="slide" axis="1 0 0" range="-1 2"/>
        </body></worldbody></mujoco>"""
    )
    servo = PositionActuator(joints=".*", stiffness=20.0, effort_limit=10.0)
    set_actuators(spec, (servo,))
    ranges = spec.compile().actuator_ctrlrange
    np.testing.assert_allclose(ranges, [[-math.pi / 2 - 0.5, math.pi / 2 + 0.5], [-1.5, 2.5]])
