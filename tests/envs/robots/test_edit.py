import math

import mujoco
import numpy as np
import pytest

from ksim_rl.envs.robots import edit

ROBOT = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.003" cone="elliptic"/>
  <default>
    <joint damping="3" frictionloss="0.5" armature="0.1"/>
    <geom friction="0.2" condim="1" margin="0.01" solref="0.005 1"/>
  </default>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
      <geom name="look" type="sphere" size="0.1" contype="0" conaffinity="0"/>
      <geom name="hull" type="sphere" size="0.1"/>
      <body name="arm" pos="0.2 0 0">
        <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>
        <joint name="arm_joint" axis="0 1 0" range="-1 1" limited="true"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="arm_joint"/></actuator>
  <keyframe><key name="home" qpos="0 0 2 1 0 0 0 0.5"/></keyframe>
</mujoco>
"""
SERVO = edit.PositionServo(
    joints=("arm_joint",),
    effort_limit=5.0,
    rotor_inertia=1e-4,
    gear_ratio=10.0,
    natural_frequency=2.0,
    damping_ratio=0.5,
)


@pytest.fixture
def spec():
    return mujoco.MjSpec.from_string(ROBOT)


def test_servo_oscillates_at_its_natural_frequency_and_damping(spec):
    edit.set_passive_joints(spec)
    edit.set_position_actuators(spec, (SERVO,))
    edit.reset_options(spec)
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.timestep = 1e-4
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model = spec.compile()
    data = mujoco.MjData(model)
    start, angular = 0.1, 2.0 * math.pi * 2.0
    data.qpos[7] = start
    seconds = 0.3
    for _ in range(round(seconds / 1e-4)):
        mujoco.mj_step(model, data)
    # Free response of q'' + 2 z w q' + w^2 q = 0 from rest; the light arm leaves only the armature.
    decay, damped = 0.5 * angular, angular * math.sqrt(1.0 - 0.5**2)
    expected = (
        start
        * math.exp(-decay * seconds)
        * (math.cos(damped * seconds) + decay / damped * math.sin(damped * seconds))
    )
    assert data.qpos[7] == pytest.approx(expected, abs=2e-4)


def test_position_actuators_replace_all_and_limit_force_only(spec):
    edit.set_position_actuators(spec, (SERVO,))
    model = spec.compile()
    assert model.nu == 1 and model.actuator(0).name == "arm_joint"
    assert list(model.actuator_forcerange[0]) == [-5.0, 5.0]
    assert not model.actuator_ctrllimited[0]
    data = mujoco.MjData(model)
    data.ctrl[0] = 100.0
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == 5.0


def test_passive_joints_lose_damping_and_friction(spec):
    edit.set_passive_joints(spec)
    model = spec.compile()
    assert not model.dof_damping.any() and not model.dof_frictionloss.any()


def test_unknown_joint_names_the_near_one(spec):
    servo = edit.PositionServo(joints=("arm_jont",), effort_limit=1.0, rotor_inertia=1.0, gear_ratio=1.0)
    with pytest.raises(ValueError, match=r"arm_jont.*arm_joint"):
        edit.set_position_actuators(spec, (servo,))


def test_replaced_geoms_ignore_default_classes_and_keep_looks_and_mass(spec):
    before = spec.copy().compile().body_mass.copy()
    ball = edit.CollisionGeom(name="ball", body="arm", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.05,))
    rod = edit.CollisionGeom(
        name="rod", body="base", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=(0.01,), fromto=(0, 0, 0, 0, 0, 0.4)
    )
    edit.replace_collision_geoms(spec, (ball, rod))
    model = spec.compile()
    assert {model.geom(i).name for i in range(model.ngeom)} == {"look", "ball", "rod"}
    np.testing.assert_allclose(model.body_mass, before)
    plain = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom name='ball' size='0.05'/></worldbody></mujoco>"
    )
    for field in ("friction", "condim", "margin", "solref", "solimp", "priority", "contype", "conaffinity"):
        np.testing.assert_array_equal(
            getattr(model, f"geom_{field}")[model.geom("ball").id], getattr(plain, f"geom_{field}")[0]
        )
    assert model.geom("rod").size[1] == pytest.approx(0.2)
    assert model.geom("rod").pos[2] == pytest.approx(0.2)


def test_geom_on_unknown_body_names_the_near_one(spec):
    geom = edit.CollisionGeom(name="x", body="bse", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.1,))
    with pytest.raises(ValueError, match=r"bse.*base"):
        edit.replace_collision_geoms(spec, (geom,))


def test_keyframe_holds_pose_and_matching_controls(spec):
    edit.set_position_actuators(spec, (SERVO,))
    edit.set_keyframe(
        spec, "start", init_pos=(1.0, 2.0, 3.0), init_quat=(1.0, 0.0, 0.0, 0.0), joint_pos={"arm_joint": 0.25}
    )
    model = spec.compile()
    assert model.nkey == 1 and model.key(0).name == "start"
    assert list(model.key_qpos[0]) == [1, 2, 3, 1, 0, 0, 0, 0.25]
    assert list(model.key_ctrl[0]) == [0.25]


def test_options_go_back_to_mujocos_own(spec):
    edit.reset_options(spec)
    assert spec.option.timestep == mujoco.MjSpec().option.timestep
    assert spec.option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL


def test_names_keep_the_models_order():
    names = ["a_1", "b_1", "a_2"]
    assert edit.match_names("joint", ("b_.*", "a_.*"), names) == names
    assert edit.match_names("joint", ("a_.*",), names) == ["a_1", "a_2"]
