import mujoco
import numpy as np
import pytest

from ksim_rl.scene.actuators import MotorActuator, PositionActuator, set_actuators
from ksim_rl.scene.robots import edit

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


@pytest.fixture
def spec():
    return mujoco.MjSpec.from_string(ROBOT)


def test_driven_joints_lose_damping_and_friction_and_passive_ones_keep_them(spec):
    spec.body("arm").add_joint(
        name="loose", type=mujoco.mjtJoint.mjJNT_HINGE, damping=[2.0, 0.0, 0.0]
    )
    edit.clear_joint_losses(spec, (PositionActuator(joints="arm_joint", stiffness=1.0),))
    model = spec.compile()
    assert model.dof_damping.tolist() == [0.0] * 7 + [2.0]
    assert model.dof_frictionloss[6] == 0.0 < model.dof_frictionloss[7]


def test_replaced_geoms_ignore_default_classes_and_keep_looks_and_mass(spec):
    before = spec.copy().compile().body_mass.copy()
    ball = edit.CollisionGeom(
        name="ball", body="arm", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.05,)
    )
    rod = edit.CollisionGeom(
        name="rod",
        body="base",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(0.01,),
        fromto=(0, 0, 0, 0, 0, 0.4),
    )
    edit.replace_collision_geoms(spec, (ball, rod))
    model = spec.compile()
    # What alone one sees of a body stays, without its name.
    assert {model.geom(i).name for i in range(model.ngeom)} == {"look", "", "ball", "rod"}
    np.testing.assert_allclose(model.body_mass, before)
    plain = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom name='ball' size='0.05'/></worldbody></mujoco>"
    )
    for field in (
        "friction",
        "condim",
        "margin",
        "solref",
        "solimp",
        "priority",
        "contype",
        "conaffinity",
    ):
        np.testing.assert_array_equal(
            getattr(model, f"geom_{field}")[model.geom("ball").id],
            getattr(plain, f"geom_{field}")[0],
        )
    assert model.geom("rod").size[1] == pytest.approx(0.2)
    assert model.geom("rod").pos[2] == pytest.approx(0.2)


STOOL = """
<mujoco>
  <compiler angle="radian" {compiler}/>
  <worldbody>
    <body name="seat">
      <freejoint/>
      <inertial pos="0 0 0.1" mass="9" fullinertia="0.3 0.2 0.25 0.01 0 0.02"/>
      <geom type="cylinder" size="0.2 0.03" {looks}/>
      <body name="leg" pos="0.1 0 0">
        <joint name="hip" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.01 0 -0.15" mass="0.4" {looks}/>
        <geom type="box" size="0.03 0.02 0.01" pos="0 0.01 -0.15" euler="0.3 0 0" mass="0.2"/>
        <body name="toe" pos="0 0 -0.15"><geom size="0.02"/></body>
        <body name="bare"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")
@pytest.mark.parametrize("looks", ["", 'contype="0" conaffinity="0"'], ids=["collides", "visual"])
@pytest.mark.parametrize("infer", ["true", "auto", "false"])
@pytest.mark.parametrize(
    "others", ["", 'settotalmass="7" balanceinertia="true"', 'fusestatic="true"']
)
def test_no_body_gains_or_loses_mass_by_its_hulls(infer, looks, others):
    xml = STOOL.format(looks=looks, compiler=f'inertiafromgeom="{infer}" {others}')
    if infer == "false":  # then every body that moves needs an inertia of its own
        xml = xml.replace(
            '<joint name="hip"',
            '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><joint name="hip"',
        )
    spec = mujoco.MjSpec.from_string(xml)
    before = mujoco.MjSpec.from_string(xml).compile()
    hulls = [
        edit.sphere(f"{body}_hull", body, 0.05, (0.0, 0.0, 0.1))
        for body in ("seat", "leg", "toe", "bare")
    ]
    edit.replace_collision_geoms(spec, hulls)
    after = spec.compile()
    assert before.nbody == after.nbody and {"seat_hull", "leg_hull"} <= {g.name for g in spec.geoms}
    for field in ("body_mass", "body_ipos", "body_inertia", "body_subtreemass"):
        np.testing.assert_allclose(
            getattr(after, field), getattr(before, field), rtol=1e-9, atol=1e-12
        )
    turned = np.abs((after.body_iquat * before.body_iquat).sum(-1))
    np.testing.assert_allclose(turned[before.body_mass > 0], 1.0, rtol=1e-9)


def test_hulls_may_be_turned(spec):
    box = edit.CollisionGeom(
        name="box",
        body="arm",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=(1, 2, 3),
        quat=(0.0, 1.0, 0.0, 0.0),
    )
    edit.replace_collision_geoms(spec, (box,))
    np.testing.assert_allclose(spec.compile().geom("box").quat, (0, 1, 0, 0))
    with pytest.raises(ValueError, match=r"'rod': fromto=.* quat=.*: give fromto alone"):
        edit.capsule("rod", "arm", 0.1, (0, 0, 0, 1, 0, 0), quat=(0.0, 1.0, 0.0, 0.0))


def test_geom_on_unknown_body_names_the_near_one(spec):
    geom = edit.CollisionGeom(name="x", body="bse", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.1,))
    with pytest.raises(ValueError, match=r"bse.*base"):
        edit.replace_collision_geoms(spec, (geom,))


def test_keyframe_holds_pose_and_matching_controls(spec):
    servo = PositionActuator(joints="arm_joint", stiffness=10.0)
    set_actuators(spec, (servo,))
    edit.set_keyframe(
        spec,
        "start",
        init_pos=(1.0, 2.0, 3.0),
        init_quat=(1.0, 0.0, 0.0, 0.0),
        joint_pos={"arm_joint": 0.25},
    )
    model = spec.compile()
    assert model.nkey == 1 and model.key(0).name == "start"
    assert list(model.key_qpos[0]) == [1, 2, 3, 1, 0, 0, 0, 0.25]
    assert list(model.key_ctrl[0]) == [0.25]


def test_keyframe_asks_motors_for_no_effort(spec):
    set_actuators(spec, (MotorActuator(joints="arm_joint"),))
    edit.set_keyframe(
        spec,
        "start",
        init_pos=(0.0, 0.0, 1.0),
        init_quat=(1.0, 0.0, 0.0, 0.0),
        joint_pos={"arm_joint": 0.25},
    )
    assert list(spec.compile().key_ctrl[0]) == [0.0]


def test_options_go_back_to_mujocos_own(spec):
    edit.reset_options(spec)
    assert spec.option.timestep == mujoco.MjSpec().option.timestep
    assert spec.option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL


def test_values_spread_over_names():
    names = ["a_hip", "a_knee", "b_hip"]
    assert edit.spread({".*_hip": 0.5, "a_knee": 1.0}, names) == {
        "a_hip": 0.5,
        "a_knee": 1.0,
        "b_hip": 0.5,
    }
    assert edit.spread({"b_.*": 2.0}, names, default=0.0) == {
        "a_hip": 0.0,
        "a_knee": 0.0,
        "b_hip": 2.0,
    }
    with pytest.raises(ValueError, match=r"'a_knee' matches 0 of the patterns.*default=0\.0"):
        edit.spread({".*_hip": 0.5}, names)
    with pytest.raises(ValueError, match="'a_hip' matches 2 of the patterns"):
        edit.spread({".*_hip": 0.5, "a_.*": 1.0}, names, default=0.0)
    with pytest.raises(ValueError, match="did you mean 'a_hip'"):
        edit.spread({"a_hop": 0.5}, names, default=0.0)


def test_inertia_of_a_gear_train_keeps_its_kinetic_energy():
    # At a joint speed of 1 rad/s the rotor turns 4 * 3 times as fast, the first stage's output 3 times.
    energy = 0.5 * 2e-5 * (4.0 * 3.0) ** 2 + 0.5 * 1e-5 * 3.0**2 + 0.5 * 3e-5
    assert 0.5 * edit.reflected_inertia((2e-5, 1e-5, 3e-5), (4.0, 3.0)) == pytest.approx(
        energy, rel=1e-12
    )


def test_sites_are_moved_or_added_and_sensors_replaced(spec):
    spec.body("base").add_site(name="imu", pos=[9.0, 9.0, 9.0])
    edit.set_sites(
        spec,
        (
            edit.Site(name="imu", body="base", pos=(0.1, 0.0, 0.0)),
            edit.Site(name="hand", body="arm"),
        ),
    )
    edit.replace_sensors(spec, edit.root_sensors(imu="imu", root="base"))
    edit.replace_sensors(spec, edit.root_sensors(imu="imu", root="base"))
    model = spec.compile()
    assert list(model.site("imu").pos) == [0.1, 0.0, 0.0]
    assert model.body(model.site_bodyid[model.site("hand").id]).name == "arm"
    assert model.nsensor == 5
    with pytest.raises(ValueError, match=r"bse.*base"):
        edit.set_sites(spec, (edit.Site(name="x", body="bse"),))


def test_a_site_moves_to_the_body_that_it_is_given(spec):
    spec.body("base").add_site(name="imu", pos=[9.0, 9.0, 9.0], quat=[0.0, 1.0, 0.0, 0.0])
    spec.add_sensor(
        name="gyro",
        type=mujoco.mjtSensor.mjSENS_GYRO,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="imu",
    )
    edit.set_sites(spec, (edit.Site(name="imu", body="base", pos=(0.2, 0.0, 0.0)),))
    model = spec.copy().compile()
    assert list(model.site("imu").quat) == [0, 1, 0, 0] and list(model.site("imu").pos) == [
        0.2,
        0,
        0,
    ]
    edit.set_sites(spec, (edit.Site(name="imu", body="arm", pos=(0.1, 0.0, 0.0)),))
    model = spec.compile()
    assert model.body(model.site_bodyid[model.site("imu").id]).name == "arm"
    assert list(model.site("imu").pos) == [0.1, 0, 0] and model.nsite == 1
    assert model.sensor("gyro").objid[0] == model.site("imu").id


def test_excluded_pairs_reach_the_model(spec):
    edit.exclude_contacts(spec, (("base", "arm"),))
    model = spec.compile()
    assert list(model.exclude_signature) == [(model.body("base").id << 16) + model.body("arm").id]
