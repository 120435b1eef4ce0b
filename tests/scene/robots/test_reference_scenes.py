"""The compiled models of robots with a reference scene agree with it, element by element."""

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.scene.robots.unitree_go import UnitreeGo1
from ksim_rl.scene.scene import SceneCfg, build_spec
from ksim_rl.scene.terrains import PlaneTerrain
from tests.scene.robots.reference import loaded_spec, reference_figures, reference_file

BODY_FIELDS = ("mass", "inertia", "pos", "quat", "ipos", "iquat", "subtreemass", "invweight0")
JOINT_FIELDS = (
    "type",
    "pos",
    "axis",
    "range",
    "limited",
    "stiffness",
    "margin",
    "solref",
    "solimp",
    "actfrclimited",
)
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
SITE_FIELDS = ("pos", "quat", "group")
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
    "noise",
    "cutoff",
)
ROBOTS = {"unitree_go1": UnitreeGo1(), "unitree_g1": UnitreeG1()}


@pytest.fixture(scope="module", params=ROBOTS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def robot(name):
    return ROBOTS[name]


@pytest.fixture(scope="module")
def model(robot):
    loaded_spec(robot)
    return build_spec(SceneCfg(robots={"robot": robot}, terrain=PlaneTerrain())).compile()


@pytest.fixture(scope="module")
def reference(name):
    return mujoco.MjModel.from_xml_path(str(reference_file(f"{name}_scene.xml")))


def _names(model, kind, count):
    return [(mujoco.mj_id2name(model, kind, i) or "").removeprefix("robot/") for i in range(count)]


def _assert_same(model, reference, kind, prefix, fields, counts):
    ours, theirs = _names(model, kind, counts[0]), _names(reference, kind, counts[1])
    assert sorted(ours) == sorted(theirs)
    for field in fields:
        mine, other = getattr(model, f"{prefix}_{field}"), getattr(reference, f"{prefix}_{field}")
        for element in theirs:
            np.testing.assert_allclose(
                mine[ours.index(element)],
                other[theirs.index(element)],
                rtol=1e-5,
                atol=1e-6,
                err_msg=f"{prefix}_{field} of {element!r}",
            )


def test_bodies_agree(model, reference):
    counts = model.nbody, reference.nbody
    _assert_same(model, reference, mujoco.mjtObj.mjOBJ_BODY, "body", BODY_FIELDS, counts)


def test_joints_and_their_dynamics_agree(model, reference):
    kind, counts = mujoco.mjtObj.mjOBJ_JOINT, (model.njnt, reference.njnt)
    _assert_same(model, reference, kind, "jnt", JOINT_FIELDS, counts)
    # Joint order agrees (asserted here), so degrees of freedom do as well.
    assert _names(model, kind, model.njnt) == _names(reference, kind, reference.njnt)
    for field in DOF_FIELDS:
        np.testing.assert_allclose(
            getattr(model, f"dof_{field}"), getattr(reference, f"dof_{field}"), rtol=1e-5, atol=1e-8
        )


def test_collision_geoms_agree(model, reference):
    colliding = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    names = {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, i) for i in colliding}
    theirs = _names(reference, mujoco.mjtObj.mjOBJ_GEOM, reference.ngeom)
    assert names == set(theirs)
    for index, element in enumerate(theirs):
        mine = model.geom(element).id
        for field in GEOM_FIELDS + COLLISION_FIELDS:
            np.testing.assert_allclose(
                getattr(model, f"geom_{field}")[mine],
                getattr(reference, f"geom_{field}")[index],
                rtol=1e-5,
                atol=1e-6,
                err_msg=f"geom_{field} of {element!r}",
            )
        body = model.body(model.geom_bodyid[mine]).name
        assert body == reference.body(reference.geom_bodyid[index]).name.removeprefix("robot/")


def test_bodies_that_may_overlap_agree(model, reference):
    def pairs(mj_model):
        signatures = mj_model.exclude_signature
        bodies = [(int(s) >> 16, int(s) & 0xFFFF) for s in signatures]
        return {
            frozenset(mj_model.body(i).name.removeprefix("robot/") for i in pair) for pair in bodies
        }

    assert pairs(model) == pairs(reference)


def test_sites_agree(model, reference):
    counts = model.nsite, reference.nsite
    kind = mujoco.mjtObj.mjOBJ_SITE
    _assert_same(model, reference, kind, "site", SITE_FIELDS, counts)
    for element in _names(model, kind, model.nsite):
        body = model.body(model.site_bodyid[model.site(element).id]).name
        other = reference.body(reference.site_bodyid[reference.site(f"robot/{element}").id]).name
        assert body == other.removeprefix("robot/")


def test_actuators_agree(model, reference):
    kind, counts = mujoco.mjtObj.mjOBJ_ACTUATOR, (model.nu, reference.nu)
    _assert_same(model, reference, kind, "actuator", ACTUATOR_FIELDS, counts)
    for index in range(model.nu):
        assert model.joint(model.actuator_trnid[index, 0]).name == model.actuator(index).name


def test_keyframe_agrees(model, reference):
    assert model.nkey == reference.nkey == 1
    assert model.key(0).name == "init_state"
    np.testing.assert_allclose(model.key_qpos, reference.key_qpos, atol=1e-7)
    np.testing.assert_allclose(model.key_ctrl, reference.key_ctrl, atol=1e-7)


def test_figures_are_those_of_the_task(name, robot):
    figures = reference_figures(name)
    assert list(robot.joint_names) == figures["joint_names"]
    assert robot.action_scale == figures["action_scale"]
    assert robot.default_joint_pos == pytest.approx(figures["default_joint_pos"], abs=1e-6)
    assert [*robot.init_pos, *robot.init_quat] == pytest.approx(
        figures["default_root_state"][:7], abs=1e-6
    )
    assert robot.soft_joint_pos_limit_factor == figures["soft_joint_pos_limit_factor"]


def test_gains_follow_from_motor_inertia_and_frequency(name, robot, model):
    figures = reference_figures(name)
    assert {model.actuator(i).name for i in range(model.nu)} == set(figures["actuators"])
    for joint, wanted in figures["actuators"].items():  # whose pi has eleven digits
        index, dof = model.actuator(joint).id, model.joint(joint).dofadr[0]
        assert model.actuator_gainprm[index, 0] == pytest.approx(wanted["kp"], rel=1e-10)
        assert model.actuator_biasprm[index, :3] == pytest.approx(
            [0.0, -wanted["kp"], -wanted["kd"]], rel=1e-10
        )
        assert list(model.actuator_forcerange[index]) == wanted["effort_limit"]
        assert model.dof_armature[dof] == pytest.approx(wanted["armature"], rel=1e-12)
        assert model.dof_damping[dof] == wanted["damping"]
        assert model.dof_frictionloss[dof] == wanted["frictionloss"]


def test_action_scale_is_a_quarter_of_the_saturating_deflection(robot, model):
    for joint, scale in robot.action_scale.items():
        index = model.actuator(joint).id
        deflection = model.actuator_forcerange[index, 1] / model.actuator_gainprm[index, 0]
        assert scale == pytest.approx(0.25 * deflection, abs=5e-6)


def test_sensors_of_the_robot_agree(model, reference):
    ours = _names(model, mujoco.mjtObj.mjOBJ_SENSOR, model.nsensor)
    theirs = _names(reference, mujoco.mjtObj.mjOBJ_SENSOR, reference.nsensor)
    # Contact sensors belong to the scene; terms read the same from ours, which have another form.
    wanted = [
        i
        for i in range(reference.nsensor)
        if reference.sensor_type[i] != mujoco.mjtSensor.mjSENS_CONTACT
    ]
    assert [theirs[i] for i in wanted] == ours
    for mine, other in enumerate(wanted):
        for field in SENSOR_FIELDS:
            np.testing.assert_array_equal(
                getattr(model, f"sensor_{field}")[mine],
                getattr(reference, f"sensor_{field}")[other],
                err_msg=f"sensor_{field} of {ours[mine]!r}",
            )
        for kinds, ids in (("sensor_objtype", "sensor_objid"), ("sensor_reftype", "sensor_refid")):
            own = mujoco.mj_id2name(model, getattr(model, kinds)[mine], getattr(model, ids)[mine])
            its = mujoco.mj_id2name(
                reference, getattr(reference, kinds)[other], getattr(reference, ids)[other]
            )
            assert own == (its and its.removeprefix("robot/"))
