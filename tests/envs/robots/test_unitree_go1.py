import mujoco
import numpy as np
import pytest

from ksim_rl.envs.robots.unitree_go1 import SERVOS, UnitreeGo1
from ksim_rl.envs.scene import PlaneTerrain, SceneCfg, build_spec
from ksim_rl.envs.sensors import ContactSensor
from tests.envs.robots.reference import loaded_spec, reference_figures, reference_file

BODY_FIELDS = ("mass", "inertia", "pos", "quat", "ipos", "iquat", "subtreemass", "invweight0")
JOINT_FIELDS = ("type", "pos", "axis", "range", "limited", "stiffness", "margin", "solref", "solimp")
DOF_FIELDS = ("damping", "frictionloss", "armature", "invweight0")
GEOM_FIELDS = (
    "type",
    "size",
    "pos",
    "quat",
    "friction",
    "condim",
    "priority",
    "solref",
    "solimp",
    "margin",
    "gap",
)
COLLISION_FIELDS = ("contype", "conaffinity", "group", "solmix")
SITE_FIELDS = ("pos", "quat", "size", "group")
ACTUATOR_FIELDS = (
    "gainprm",
    "biasprm",
    "gaintype",
    "biastype",
    "dyntype",
    "trntype",
    "gear",
    "forcerange",
    "forcelimited",
    "ctrlrange",
    "ctrllimited",
)
SENSOR_FIELDS = (
    "type",
    "datatype",
    "needstage",
    "objtype",
    "reftype",
    "intprm",
    "dim",
    "adr",
    "noise",
    "cutoff",
)


@pytest.fixture(scope="module")
def model():
    loaded_spec(UnitreeGo1())
    scene = SceneCfg(
        robots={"robot": UnitreeGo1()},
        terrain=PlaneTerrain(),
        sensors={"feet_ground_contact": ContactSensor(geoms=UnitreeGo1.foot_geoms)},
    )
    return build_spec(scene).compile()


@pytest.fixture(scope="module")
def reference():
    return mujoco.MjModel.from_xml_path(str(reference_file("unitree_go1_scene.xml")))


def _names(model, kind, count):
    return [(mujoco.mj_id2name(model, kind, i) or "").removeprefix("robot/") for i in range(count)]


def _assert_same(model, reference, kind, prefix, fields, counts):
    ours, theirs = _names(model, kind, counts[0]), _names(reference, kind, counts[1])
    assert sorted(ours) == sorted(theirs)
    for field in fields:
        mine, other = getattr(model, f"{prefix}_{field}"), getattr(reference, f"{prefix}_{field}")
        for name in theirs:
            np.testing.assert_allclose(
                mine[ours.index(name)],
                other[theirs.index(name)],
                rtol=1e-5,
                atol=1e-6,
                err_msg=f"{prefix}_{field} of {name!r}",
            )


def test_bodies_agree_with_the_reference_scene(model, reference):
    counts = model.nbody, reference.nbody
    _assert_same(model, reference, mujoco.mjtObj.mjOBJ_BODY, "body", BODY_FIELDS, counts)


def test_joints_and_their_dynamics_agree_with_the_reference_scene(model, reference):
    counts = model.njnt, reference.njnt
    _assert_same(model, reference, mujoco.mjtObj.mjOBJ_JOINT, "jnt", JOINT_FIELDS, counts)
    for field in DOF_FIELDS:
        # Joint order agrees (asserted here), so degrees of freedom do as well.
        kind = mujoco.mjtObj.mjOBJ_JOINT
        assert _names(model, kind, model.njnt) == _names(reference, kind, reference.njnt)
        np.testing.assert_allclose(
            getattr(model, f"dof_{field}"), getattr(reference, f"dof_{field}"), rtol=1e-5, atol=1e-9
        )


def test_collision_geoms_agree_with_the_reference_scene(model, reference):
    colliding = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    names = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i) for i in colliding}
    kind, count = mujoco.mjtObj.mjOBJ_GEOM, reference.ngeom
    theirs = _names(reference, kind, count)
    assert names == set(theirs)
    for field in GEOM_FIELDS + COLLISION_FIELDS:
        for index, name in enumerate(theirs):
            np.testing.assert_allclose(
                getattr(model, f"geom_{field}")[model.geom(name).id],
                getattr(reference, f"geom_{field}")[index],
                rtol=1e-5,
                atol=1e-6,
                err_msg=f"geom_{field} of {name!r}",
            )
            body = model.body(model.geom_bodyid[model.geom(name).id]).name
            assert body == reference.body(reference.geom_bodyid[index]).name.removeprefix("robot/")


def test_sites_agree_with_the_reference_scene(model, reference):
    counts = model.nsite, reference.nsite
    _assert_same(model, reference, mujoco.mjtObj.mjOBJ_SITE, "site", SITE_FIELDS, counts)


def test_actuators_agree_with_the_reference_scene(model, reference):
    counts = model.nu, reference.nu
    _assert_same(model, reference, mujoco.mjtObj.mjOBJ_ACTUATOR, "actuator", ACTUATOR_FIELDS, counts)
    for index in range(model.nu):
        assert model.joint(model.actuator_trnid[index, 0]).name == model.actuator(index).name


def test_sensors_agree_with_the_reference_scene(model, reference):
    counts = model.nsensor, reference.nsensor
    _assert_same(model, reference, mujoco.mjtObj.mjOBJ_SENSOR, "sensor", SENSOR_FIELDS, counts)
    for index in range(model.nsensor):
        for kinds, ids in (("sensor_objtype", "sensor_objid"), ("sensor_reftype", "sensor_refid")):
            ours = mujoco.mj_id2name(model, getattr(model, kinds)[index], getattr(model, ids)[index])
            theirs = mujoco.mj_id2name(
                reference, getattr(reference, kinds)[index], getattr(reference, ids)[index]
            )
            assert ours == (theirs and theirs.removeprefix("robot/"))


def test_keyframe_agrees_with_the_reference_scene(model, reference):
    assert model.nkey == reference.nkey == 1
    assert model.key(0).name == "init_state"
    np.testing.assert_allclose(model.key_qpos, reference.key_qpos, atol=1e-7)
    np.testing.assert_allclose(model.key_ctrl, reference.key_ctrl, atol=1e-7)


def test_figures_are_those_of_the_task():
    figures, robot = reference_figures("unitree_go1"), UnitreeGo1()
    assert list(robot.joint_names) == figures["joint_names"]
    assert robot.action_scale == figures["action_scale"]
    assert robot.default_joint_pos == pytest.approx(figures["default_joint_pos"], abs=1e-6)
    assert [*robot.init_pos, *robot.init_quat] == pytest.approx(figures["default_root_state"][:7], abs=1e-6)
    assert robot.soft_joint_pos_limit_factor == figures["soft_joint_pos_limit_factor"]


def test_gains_follow_from_rotor_inertia_and_frequency():
    figures, model = reference_figures("unitree_go1"), loaded_spec(UnitreeGo1()).compile()
    for name, wanted in figures["actuators"].items():  # whose pi has eleven digits
        index, dof = model.actuator(name).id, model.joint(name).dofadr[0]
        assert model.actuator_gainprm[index, 0] == pytest.approx(wanted["kp"], rel=1e-10)
        assert model.actuator_biasprm[index, :3] == pytest.approx(
            [0.0, -wanted["kp"], -wanted["kd"]], rel=1e-10
        )
        assert list(model.actuator_forcerange[index]) == wanted["effort_limit"]
        assert model.dof_armature[dof] == pytest.approx(wanted["armature"], rel=1e-12)
        assert model.dof_damping[dof] == wanted["damping"]
        assert model.dof_frictionloss[dof] == wanted["frictionloss"]


def test_action_scale_is_a_quarter_of_the_saturating_deflection():
    robot = UnitreeGo1()
    for servo, joint in ((SERVOS[0], "FR_thigh_joint"), (SERVOS[1], "FR_calf_joint")):
        assert robot.action_scale[joint] == pytest.approx(0.25 * servo.effort_limit / servo.kp, abs=5e-6)


def test_stance_stands_on_all_four_feet(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    lowest = [data.geom(name).xpos[2] - model.geom(name).size[0] for name in UnitreeGo1.foot_geoms]
    assert max(lowest) - min(lowest) < 1e-6
    assert abs(lowest[0]) < 0.02
    for _ in range(int(2.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    # The servos are soft: under its weight the robot sags and leans a little.
    assert data.body("trunk").xmat[8] > 0.95
    assert 0.2 < data.qpos[2] < 0.32


def test_spec_is_fresh_each_time():
    first = loaded_spec(UnitreeGo1())
    first.delete(first.site("imu"))
    assert loaded_spec(UnitreeGo1()).site("imu") is not None
