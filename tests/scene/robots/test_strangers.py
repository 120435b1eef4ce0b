"""What strangers put into robots' files is kept, replaced or refused by name, and the robots stand as meant."""

import mujoco
import numpy as np
import pytest

from ksim_rl.envs.robots import analyse
from ksim_rl.scene.robots.anatomy import posed
from ksim_rl.scene.robots.edit import replace_collision_geoms
from ksim_rl.scene.robots.upright_root import name_all, turn_root
from tests.scene.robots.test_analysis import biped

DOG_LEG = """
<body name="{name}_thigh" pos="{x} {y} {z}">
  <joint name="{name}_hip" axis="0 1 0"/>
  <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="0.5"/>
  <body name="{name}_shank" pos="0 0 -0.2">
    <joint name="{name}_knee" axis="0 1 0" {knee}/>
    <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.18" mass="0.2"/>{foot}
  </body>
</body>"""
TOE = '<geom size="0.02" pos="0 0 -0.2" mass="0.1"/>'
CORNERS = {
    "front_left": (0.2, 0.1),
    "front_right": (0.2, -0.1),
    "rear_left": (-0.2, 0.1),
    "rear_right": (-0.2, -0.1),
}


def dog(
    *,
    knee: str = "",
    foot: str = TOE,
    rear_z: float = 0.0,
    root: str = "",
    inertial: str = "",
    extra: str = "",
):
    """Return the XML of a quadruped with two joints a leg, whose rear hips are `rear_z` m above the front ones."""
    legs = "".join(
        DOG_LEG.format(name=name, x=x, y=y, z=rear_z if x < 0 else 0.0, knee=knee, foot=foot)
        for name, (x, y) in CORNERS.items()
    )
    return f"""
<mujoco model="dog">
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="trunk" pos="0 0 0.5" {root}><freejoint/>{inertial}
      <geom name="trunk" type="box" size="0.25 0.1 0.05" mass="6"/><site name="back" pos="0 0 0.05"/>{legs}
    </body>
  </worldbody>{extra}
</mujoco>"""


def names(mj_model: mujoco.MjModel, kind: str, count: int) -> set[str]:
    """Return the names of all elements of a kind."""
    return {getattr(mj_model, kind)(number).name for number in range(count)}


# -- elements that refer to others -------------------------------------------------------------------------------


PAIR = '<contact><pair geom1="trunk" geom2="trunk2"/></contact>'
SECOND = '<body name="pack" pos="0 0 0.1"><geom name="trunk2" size="0.03" mass="0.1"/></body>'
REFERRING = {
    "a pair of geoms": PAIR,
    "a sensor of geoms": '<sensor><distance geom1="trunk" geom2="trunk2" cutoff="1"/></sensor>',
    "a custom tuple": '<custom><tuple name="t"><element objtype="geom" objname="trunk"/></tuple></custom>',
    "a servo of a tendon": """<tendon><fixed name="t"><joint joint="front_left_knee" coef="1"/></fixed></tendon>
        <actuator><position tendon="t" kp="5"/></actuator>""",
    "a servo of a site": '<actuator><position site="back" kp="5" gear="0 0 1 0 0 0"/></actuator>',
    "a sensor of such a servo": """<actuator><position name="s" site="back" gear="0 0 1 0 0 0"/></actuator>
        <sensor><actuatorfrc actuator="s"/></sensor>""",
    "adhesion": '<actuator><adhesion body="trunk" ctrlrange="0 1"/></actuator>',
    "a tendon around a geom": """<tendon><spatial><site site="back"/><geom geom="trunk2"/><site site="tip"/></spatial>
        </tendon>""",
}


@pytest.mark.parametrize("extra", REFERRING.values(), ids=REFERRING)
def test_what_refers_to_replaced_elements_goes_with_them(extra):
    motors = "".join(
        f'<motor joint="{name}_{joint}"/>' for name in CORNERS for joint in ("hip", "knee")
    )
    xml = dog(extra=f"{extra}<actuator>{motors}</actuator>")
    xml = xml.replace("<freejoint/>", f"<freejoint/>{SECOND}<site name='tip' pos='0 0 0.2'/>")
    given = mujoco.MjModel.from_xml_string(xml)
    found = analyse(xml)
    mj_model = found.robot.spec().compile()
    assert found.stands_s == 5.0 and len(found.foot_bodies) == 4
    assert mj_model.npair == 0 and names(mj_model, "actuator", mj_model.nu) == set(
        found.robot.joint_names
    )
    assert mj_model.body_subtreemass[0] == pytest.approx(given.body_subtreemass[0])
    np.testing.assert_allclose(mj_model.body("pack").inertia, given.body("pack").inertia)


def test_a_geom_that_a_tendon_wraps_around_stays_and_does_not_collide():
    xml = dog(extra=REFERRING["a tendon around a geom"])
    xml = xml.replace("<freejoint/>", f"<freejoint/>{SECOND}<site name='tip' pos='0 0 0.2'/>")
    spec = mujoco.MjSpec.from_string(xml)
    before = spec.copy().compile()
    replace_collision_geoms(spec, [])
    after = spec.compile()
    assert after.geom("trunk2").contype == after.geom("trunk2").conaffinity == 0
    lengths = []
    for mj_model in (before, after):
        data = mujoco.MjData(mj_model)
        mujoco.mj_forward(mj_model, data)
        lengths.append(data.ten_length[0])
    assert lengths[0] == lengths[1] > 0.0


def test_ball_joints_stay_as_they_are_and_the_robot_stands():
    ball = '<joint name="tail" type="ball" damping="0.1"/><geom size="0.02" mass="0.1"/>'
    tail = f'<body name="tail" pos="-0.3 0 0">{ball}</body>'
    key = '<keyframe><key qpos="0 0 0.5 1 0 0 0 0.7 0.7 0 0 0 0 0 0 0 0 0 0"/></keyframe>'
    found = analyse(dog(extra=key).replace("<freejoint/>", f"<freejoint/>{tail}"))
    mj_model = found.robot.spec().compile()
    assert found.stands_s == 5.0 and "tail" not in found.robot.joint_names
    first = mj_model.jnt_qposadr[mj_model.joint("tail").id]
    np.testing.assert_array_equal(mj_model.key_qpos[0, first : first + 4], [1.0, 0.0, 0.0, 0.0])
    for name, angle in found.robot.default_joint_pos.items():
        assert mj_model.key_qpos[0, mj_model.jnt_qposadr[mj_model.joint(name).id]] == pytest.approx(
            angle
        )


# -- poses -------------------------------------------------------------------------------------------------------


LYING = '<key name="lying" qpos="0 0 0.1 0.7071068 0.7071068 0 0 0 0 0 0 0 0 0 0"/>'
CROUCH = '<key name="crouch" qpos="0 0 0.4 1 0 0 0 0.6 -1.2 0.6 -1.2 0.6 -1.2 0.6 -1.2"/>'


def test_a_keyframe_that_lies_is_passed_over():
    found = analyse(dog(extra=f"<keyframe>{LYING}{CROUCH}</keyframe>"))
    assert found.pose == "crouch" and found.stands_s == 5.0
    assert "stance from crouch: root" in found.table()
    assert found.robot.default_joint_pos["rear_left_knee"] < -0.8


def test_the_models_own_pose_is_tried_last():
    bad = '<key name="bad" qpos="0 0 0.5 1 0 0 0 1.5 1.5 -1.5 1.5 1.5 1.5 -1.5 1.5"/>'
    assert analyse(dog(extra=f"<keyframe>{LYING}</keyframe>")).pose == "qpos0"
    assert analyse(dog(extra=f"<keyframe>{CROUCH}{bad}</keyframe>")).pose == "crouch"


def test_a_pose_may_be_named():
    xml = dog(
        extra=f"<keyframe>{CROUCH}{CROUCH.replace('crouch', 'deeper').replace('0.6 -1.2', '0.8 -1.6')}</keyframe>"
    )
    deeper = analyse(xml, pose="deeper")
    assert deeper.pose == "deeper" and analyse(xml).pose == "crouch"
    assert deeper.robot.init_pos[2] < analyse(xml).robot.init_pos[2] - 0.03
    assert analyse(xml, pose="qpos0").pose == "qpos0"
    with pytest.raises(ValueError, match="no pose 'deper': did you mean 'deeper'"):
        analyse(xml, pose="deper")


def test_legs_of_one_build_are_feet_wherever_a_pose_has_them():
    found = analyse(dog(rear_z=0.1))
    assert set(found.foot_bodies) == {f"{name}_shank" for name in CORNERS}


SIDEWAYS = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0])
INERTIAL = '<inertial mass="6" pos="0.02 0.01 0" euler="10 20 30" diaginertia="0.03 0.1 0.12"/>'


@pytest.mark.parametrize("inertial", ["", INERTIAL], ids=["of geoms", "explicit"])
def test_a_root_whose_z_axis_is_not_up_stands_as_the_same_robot_does(inertial):
    plain = mujoco.MjSpec.from_string(dog(inertial=inertial))
    sideways = plain.copy()
    turn_root(sideways, "trunk", tuple(SIDEWAYS))
    sideways.body("trunk").quat = SIDEWAYS
    found, expected = analyse(sideways), analyse(plain)
    assert found.stands_s == expected.stands_s == 5.0
    assert "z axis points up in the stance" in found.table()
    assert found.com_height == pytest.approx(expected.com_height, abs=1e-3)
    assert found.robot.init_pos == pytest.approx(expected.robot.init_pos, abs=2e-3)
    np.testing.assert_allclose(found.robot.init_quat, [1.0, 0.0, 0.0, 0.0], atol=1e-5)
    # The frame of the root has its z axis up, as all that walking tasks read needs, and its inertia is the same.
    models = [analysis.robot.spec().compile() for analysis in (found, expected)]
    states = [posed(mj_model, models[1].key_qpos[0]) for mj_model in models]
    np.testing.assert_allclose(
        states[0].body("trunk").xmat, states[1].body("trunk").xmat, atol=1e-5
    )
    np.testing.assert_allclose(states[0].site_xpos, states[1].site_xpos, atol=2e-3)
    matrices = []
    for mj_model, data in zip(models, states, strict=True):
        full = np.zeros((mj_model.nv, mj_model.nv))
        mujoco.mj_fullM(mj_model, data, full)
        matrices.append(full)
    np.testing.assert_allclose(matrices[0], matrices[1], atol=1e-5)


def test_turning_the_root_moves_nothing_in_the_world():
    before = mujoco.MjSpec.from_string(dog(inertial=INERTIAL))
    after = before.copy()
    turn_root(after, "trunk", tuple(SIDEWAYS))
    after.body("trunk").quat = SIDEWAYS
    states = [posed(model, model.qpos0) for model in (before.compile(), after.compile())]
    for name in ("geom_xpos", "geom_xmat", "xipos", "site_xmat"):
        np.testing.assert_allclose(getattr(states[0], name), getattr(states[1], name), atol=1e-12)


# -- feet, wheels, springs, rods ---------------------------------------------------------------------------------


def test_a_foot_that_treads_on_a_ridge_has_one_capsule_along_it():
    ridge = '<geom type="box" size="0.1 0.004 0.01" pos="0.03 0 -0.03" mass="0.5"/>'
    box = '<geom type="box" size="0.1 0.04 0.01" pos="0.03 0 -0.03" mass="0.5"/>'
    found = analyse(biped().replace(box, ridge))
    assert found.robot.foot_geoms == ("left_foot_sole1", "right_foot_sole1")
    sole = found.robot.spec().compile().geom("left_foot_sole1")
    assert 2 * (sole.size[0] + sole.size[1]) == pytest.approx(0.2, abs=1e-3)


def test_a_slanted_capsule_treads_with_its_lower_end():
    slanted = '<geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 -0.18" mass="0.2"/>'
    found = analyse(dog(foot=slanted).replace('size="0.015"', 'size="0.001"'))
    assert found.stands_s == 5.0
    sole = found.robot.spec().compile().geom("front_left_shank_sole")
    assert sole.size[0] == pytest.approx(0.02) and sole.type == mujoco.mjtGeom.mjGEOM_SPHERE
    np.testing.assert_allclose(sole.pos, [0.1, 0.0, -0.18], atol=1e-3)


def test_wheels_are_no_feet():
    wheel = '<geom type="cylinder" size="0.1 0.02" zaxis="0 1 0" mass="0.4"/>'
    cart = "".join(
        f'<body name="{n}" pos="{x} {y} 0"><joint name="{n}_axle" axis="0 1 0"/>{wheel}</body>'
        for n, (x, y) in CORNERS.items()
    )
    box = '<geom type="box" size="0.3 0.1 0.05" mass="5"/>'
    xml = (
        f"<mujoco><worldbody><body name='cart'><freejoint/>{box}{cart}</body></worldbody></mujoco>"
    )
    with pytest.raises(
        ValueError, match="'front_left' is a wheel, which turns about joint 'front_left_axle'"
    ):
        analyse(xml)


def test_springs_stay_springs():
    found = analyse(dog(knee='stiffness="300" springref="0" damping="2" frictionloss="0.1"'))
    knees = {f"{name}_knee" for name in CORNERS}
    assert set(found.passive_joints) == knees and set(found.robot.joint_names) == {
        f"{n}_hip" for n in CORNERS
    }
    mj_model = found.robot.spec().compile()
    for knee in knees:
        dof = mj_model.joint(knee).dofadr[0]
        assert mj_model.joint(knee).stiffness == 300.0
        assert (mj_model.dof_damping[dof], mj_model.dof_frictionloss[dof]) == (2.0, 0.1)
    assert names(mj_model, "actuator", mj_model.nu) == {f"{name}_hip" for name in CORNERS}


def test_rods_of_closed_chains_stay_passive_and_hold_together():
    rod = """<body name="{name}_rod" pos="0.05 0 0"><joint name="{name}_rod" axis="0 1 0"/>
      <geom type="capsule" size="0.005" fromto="0 0 0 0 0 -0.2" mass="0.05" contype="0" conaffinity="0"/></body>"""
    xml = dog(knee='range="-2 -0.1" limited="true"')
    links, motors = [], []
    for name in CORNERS:
        hip = f'<joint name="{name}_hip" axis="0 1 0"/>'
        xml = xml.replace(hip, hip + rod.format(name=name))
        links.append(f'<connect body1="{name}_rod" body2="{name}_shank" anchor="0 0 -0.2"/>')
        motors += [f'<motor joint="{name}_hip"/>', f'<motor joint="{name}_knee"/>']
    extra = f"<equality>{''.join(links)}</equality><actuator>{''.join(motors)}</actuator>"
    found = analyse(xml.replace("</mujoco>", f"{extra}</mujoco>"))
    assert set(found.passive_joints) == {f"{name}_rod" for name in CORNERS}
    mj_model = found.robot.spec().compile()
    data = posed(mj_model, mj_model.key_qpos[0])
    assert data.ne == 12 and np.abs(data.efc_pos[: data.ne]).max() < 2e-3
    assert found.stands_s == 5.0


def test_names_are_given_where_a_file_has_none():
    xml = dog().replace('name="front_left_thigh"', "").replace('name="front_left_knee"', "")
    spec = mujoco.MjSpec.from_string(xml)
    assert name_all(spec) == ["body2", "joint2"] and name_all(spec) == []
    found = analyse(xml)
    assert found.stands_s == 5.0 and "joint2" in found.robot.joint_names
    assert "no names, so they get these: body2, joint2" in found.table()


def test_the_base_of_a_urdf_file_is_freed(tmp_path):
    inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
    links = f'<link name="trunk"><inertial><mass value="6"/>{inertia}</inertial></link>'
    for name, (x, y) in CORNERS.items():
        for part, parent, origin in (
            ("thigh", "trunk", f"{x} {y} 0"),
            ("shank", f"{name}_thigh", "0 0 -0.2"),
        ):
            link = f"{name}_{part}"
            links += f"""
              <link name="{link}"><inertial><mass value="0.4"/>{inertia}</inertial>
                <collision><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.02"/></geometry></collision></link>
              <joint name="{link}" type="revolute"><parent link="{parent}"/><child link="{link}"/><axis xyz="0 1 0"/>
                <origin xyz="{origin}"/><limit lower="-2" upper="2" effort="40" velocity="9"/></joint>"""
    path = tmp_path / "dog.urdf"
    path.write_text(f'<robot name="dog">{links}</robot>')
    found = analyse(str(path))
    assert found.stands_s == 5.0 and len(found.foot_bodies) == 4 and found.robot.free_root
    assert "the base trunk is freed" in found.table()
    assert {joint.effort_limit for joint in found.joints} == {40.0}
    mj_model = found.robot.spec().compile()
    assert mj_model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and mj_model.nv == 14


# -- props, and what one sees ------------------------------------------------------------------------------------


PROP = """<body name="{name}" pos="1 0 0.2"><freejoint/><geom name="{name}" size="0.1" mass="1"/></body>"""
KEY = """<keyframe><key name="up" qpos="{first}0 0 0.5 1 0 0 0 0.1 -0.2 0.1 -0.2 0.1 -0.2 0.1 -0.2"/></keyframe>"""


def with_props(*props: str) -> str:
    text = dog(extra=KEY.format(first="1 0 0.2 1 0 0 0 " * len(props)))
    bodies = "".join(PROP.format(name=name) for name in props)
    return text.replace("<worldbody>", f"<worldbody>{bodies}", 1)


def test_props_are_named_and_may_be_dropped():
    text = with_props("ball", "cube")
    with pytest.raises(ValueError, match="3 free joints.*by --drop ball --drop cube"):
        analyse(text)
    found = analyse(text, drop=("ball", "cube"))
    alone = analyse(with_props())
    assert found.robot.dropped == ("ball", "cube") and "left out" in " ".join(found.notes)
    assert found.mass == alone.mass and found.stands_s == alone.stands_s
    ours, theirs = found.robot.spec().compile(), alone.robot.spec().compile()
    np.testing.assert_allclose(ours.key_qpos, theirs.key_qpos)
    assert names(ours, "body", ours.nbody) == names(theirs, "body", theirs.nbody)


def test_a_body_to_drop_that_is_not_there_gets_the_near_names():
    with pytest.raises(ValueError, match="unknown body 'bal'.*'ball'"):
        analyse(with_props("ball"), drop=("bal",))


def test_robots_without_visual_geoms_keep_their_looks_and_inertia():
    robot = analyse(dog()).robot
    given = mujoco.MjModel.from_xml_string(dog())
    made = robot.spec().compile()
    for number in range(1, given.nbody):
        name = given.body(number).name
        own = made.geom_bodyid == made.body(name).id
        seen = own & (made.geom_group <= 2)
        assert seen.sum() == (given.geom_bodyid == number).sum(), name
        assert not (made.geom_contype[seen] | made.geom_conaffinity[seen]).any()
        assert made.body(name).mass == pytest.approx(given.body(name).mass)
        np.testing.assert_allclose(made.body(name).inertia, given.body(name).inertia, rtol=1e-6)


def test_visual_geoms_of_a_file_are_all_that_one_sees():
    both = (
        TOE
        + '<geom name="look_{name}" size="0.03" contype="0" conaffinity="0" group="2" mass="0"/>'
    )
    spec = mujoco.MjSpec.from_string(
        dog(foot=both.replace("_{name}", "")).replace('name="look"', "")
    )
    replace_collision_geoms(spec, [])
    shanks = [geom for geom in spec.geoms if geom.parent.name.endswith("shank")]
    assert len(shanks) == 4 and all(geom.group == 2 and not geom.contype for geom in shanks)
