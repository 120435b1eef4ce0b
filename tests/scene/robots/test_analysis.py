"""Unknown robots: what `analyse` finds is true of the model, and what it proposes stands."""

import dataclasses

import mujoco
import numpy as np
import pytest
import torch
import yaml

from ksim_rl.config.config_tree import from_tree, to_tree
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from ksim_rl.envs.robots import ModelRobot, analyse
from ksim_rl.scene.robots.control_models import Hopper
from ksim_rl.scene.robots.own_robots import Humanoid, Quadruped
from ksim_rl.scene.robots.stance import on_plane, stand
from ksim_rl.scene.scene import MjcfRobot
from ksim_rl.tasks.velocity import VelocityTask
from ksim_rl.testing import check_env
from tests.docs import guide
from tests.scene.robots.reference import loaded_spec

MENAGERIE = {"unitree_a1/a1": 4, "robotis_op3/op3": 2, "unitree_g1/g1": 2}
MORE = {"unitree_go1/go1": 4, "unitree_go2/go2": 4, "booster_t1/t1": 2, "unitree_a1": 4}

LEG = """
<body name="{side}_thigh" pos="0 {y} 0">
  <joint name="{side}_hip_roll" axis="1 0 0"/><joint name="{side}_hip" axis="0 {sign} 0"/>
  <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="2"/>
  <body name="{side}_shank" pos="0 0 -0.3">
    <joint name="{side}_knee" axis="0 {sign} 0"/>
    <geom type="capsule" size="0.025" fromto="0 0 0 0 0 -0.3" mass="1.5"/>
    <body name="{side}_foot" pos="0 0 -0.3">
      <joint name="{side}_ankle" axis="0 {sign} 0"/><joint name="{side}_ankle_roll" axis="1 0 0"/>
      {sole}
    </body>
  </body>
</body>"""
SOLES = {
    "box": '<geom type="box" size="0.1 0.04 0.01" pos="0.03 0 -0.03" mass="0.5"/>',
    "mesh": '<geom type="mesh" mesh="sole" mass="0.5"/>',
    "several": "".join(
        f'<geom size="0.005" pos="{x} {y} -0.035" mass="0.1"/>'
        for x in (-0.07, 0.13)
        for y in (-0.035, 0.035)
    ),
}


def biped(sole="box", *, mirrored=False, actuators="", root="<freejoint/>"):
    """Return the XML of a biped with torque motors, without armature, ranges or a keyframe."""
    legs = "".join(
        LEG.format(side=side, y=y, sign=-1 if mirrored and y < 0 else 1, sole=SOLES[sole])
        for side, y in (("left", 0.1), ("right", -0.1))
    )
    corners = " ".join(
        f"{x} {y} {z}" for x in (-0.07, 0.13) for y in (-0.04, 0.04) for z in (-0.04, -0.02)
    )
    return f"""
<mujoco model="Biped X">
  <asset><mesh name="sole" vertex="{corners}"/></asset>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <body name="torso" pos="0 0 0.7">{root}
      <geom type="box" size="0.08 0.12 0.2" pos="0.08 0 0.2" mass="12"/>{legs}
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
</mujoco>"""


def check_proposals(found, num_feet):
    """Check what must hold of every robot, on the model that the proposals make."""
    robot = found.robot
    model = robot.spec().compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    # All soles are on the ground, and the centre of mass stands over their middle.
    bottoms = [data.geom(name).xpos[2] - model.geom(name).size[0] for name in robot.foot_geoms]
    assert np.abs(bottoms).max() < 0.003
    feet = np.array([data.site(site).xpos for site in robot.foot_sites])
    assert len(feet) == num_feet and np.abs(feet[:, 2]).max() < 0.003
    assert np.abs(data.subtree_com[1, :2] - feet[:, :2].mean(0)).max() < 0.004
    # It touches nothing with itself, and holds this pose without a policy.
    assert not data.ncon
    standing = stand(on_plane(robot.spec()))
    assert standing.seconds == found.stands_s == 5.0 and standing.drift < 0.1
    assert found.knee_sag < 0.15
    assert found.mass == pytest.approx(model.body_subtreemass[0])
    if num_feet == 2:
        assert found.ankle_stiffness_ratio > 1.0
    limits = model.jnt_range[1:][model.jnt_limited[1:] == 1]
    pose = model.key_qpos[0, 7:][model.jnt_limited[1:] == 1]
    assert ((pose >= limits[:, 0] - 1e-6) & (pose <= limits[:, 1] + 1e-6)).all()
    for joint in found.joints:
        assert (
            joint.stiffness > 0.0
            and joint.servo_damping > 0.0
            and 0.15 <= joint.action_scale <= 0.5
        )
    assert found.njmax >= 8 and found.nconmax >= 8
    assert all(joint.name in found.table() for joint in found.joints)


@pytest.mark.parametrize(
    "source", [*MENAGERIE, *(pytest.param(source, marks=pytest.mark.full) for source in MORE)]
)
def test_robots_of_the_menagerie_stand_on_what_is_proposed(source):
    loaded_spec(MjcfRobot(source=source))
    found = analyse(source)
    check_proposals(found, (MENAGERIE | MORE)[source])
    assert found.robot.name == source.rpartition("/")[2] and found.robot.model == source


@pytest.mark.parametrize(
    "robot",
    [Quadruped(), pytest.param(Humanoid(), marks=pytest.mark.full)],
    ids=lambda robot: robot.name,
)
def test_a_spec_is_analysed_like_a_file(robot):
    check_proposals(analyse(robot.spec()), len(robot.foot_sites))


def bipeds():
    """Each sole, and a right leg with the left one's axes beside a mirrored one; all pairs in full runs."""
    pairs = [(sole, mirrored) for sole in SOLES for mirrored in (False, True)]
    return [
        pytest.param(*pair, marks=[pytest.mark.full] if number in (1, 2, 5) else [])
        for number, pair in enumerate(pairs)
    ]


@pytest.mark.parametrize(("sole", "mirrored"), bipeds())
def test_a_biped_without_motors_armature_ranges_or_pose_stands(sole, mirrored):
    found = analyse(biped(sole, mirrored=mirrored))
    check_proposals(found, 2)
    assert found.robot.name == "biped_x" and found.robot.root_body == "torso"
    assert (
        set(found.foot_bodies) == {"left_foot", "right_foot"} and len(found.robot.foot_geoms) == 4
    )
    assert set(found.pitch_joints) == {
        f"{s}_{j}" for s in ("left", "right") for j in ("hip", "knee", "ankle")
    }
    effort, armature = found.notes
    assert "no effort limit" in effort and "no armature" in armature and "left_knee" in effort
    knees = {joint.name: joint.stance for joint in found.joints}
    # Thighs forward, shanks back, whichever way the axes point.
    assert knees["left_knee"] > 0.3 and (knees["right_knee"] > 0.3) == (not mirrored)


def test_motors_and_servos_are_told_apart_with_their_limits():
    actuators = """
      <motor joint="left_hip" gear="20" ctrlrange="-2 3" ctrllimited="true"/>
      <position joint="left_knee" kp="50" kv="2" forcerange="-40 40"/>
      <velocity joint="left_ankle" kv="3" gear="2"/>"""
    found = analyse(biped(actuators=actuators))
    joints = {joint.name: joint for joint in found.joints}
    # What it can exert both ways, as the servo that takes its place does.
    assert (joints["left_hip"].actuator, joints["left_hip"].effort_limit) == ("motor", 40.0)
    assert (joints["left_knee"].actuator, joints["left_knee"].effort_limit) == ("position", 40.0)
    assert joints["left_knee"].gains == (50.0, 2.0) and joints["left_ankle"].gains == (0.0, 12.0)
    assert joints["left_ankle"].actuator == "velocity"
    # What no actuator moves has no motor, and gets none.
    assert set(found.passive_joints) == {
        f"right_{joint}" for joint in ("hip_roll", "hip", "knee", "ankle", "ankle_roll")
    } | {"left_hip_roll", "left_ankle_roll"}
    assert set(found.robot.joint_names) == set(joints) == {"left_hip", "left_knee", "left_ankle"}
    assert "no motor, and none is given: left_hip_roll" in found.table()


def test_what_is_no_legged_robot_is_refused_with_what_it_lacks():
    with pytest.raises(ValueError, match="0 free joints: expected one"):
        analyse(Hopper().spec())
    ball = "<mujoco><worldbody><body name='ball'><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    with pytest.raises(ValueError, match="no feet to stand on"):
        analyse(ball)


def test_the_code_builds_the_robot_that_was_proposed():
    found = analyse(biped())
    scope: dict = {}
    exec(found.code(), scope)  # noqa: S102
    assert scope["BIPED_X"] == found.robot
    assert scope["TASK"].name == "biped_x_velocity_flat"
    assert scope["TASK"].cfg() == VelocityTask.for_robot(biped()).cfg()


@pytest.mark.parametrize("source", [biped(), Quadruped().spec()], ids=["biped", "quadruped"])
def test_a_task_of_the_proposals_survives_the_way_through_a_file(source):
    task = VelocityTask.for_robot(source, name="mine")
    assert [training.objective.symmetry for training in task.other_trainings] == ["none"]
    cfg = task.cfg()
    tree = yaml.safe_load(yaml.safe_dump(to_tree(cfg, ManagerBasedRlEnvCfg)))
    built = from_tree(ManagerBasedRlEnvCfg, tree)
    assert built == cfg
    (robot,) = built.scene.robots.values()
    assert isinstance(robot, ModelRobot) and robot.spec().compile().nkey == 1


@pytest.mark.full
@pytest.mark.parametrize("source", ["unitree_a1/a1", "robotis_op3/op3"])
def test_a_task_of_the_proposals_keeps_the_contract_and_stands(source):
    loaded_spec(MjcfRobot(source=source))
    cfg = VelocityTask.for_robot(source).cfg()
    scene = dataclasses.replace(cfg.scene, num_envs=8)
    calm = {name: event for name, event in cfg.events.items() if name != "push_robot"}
    env = ManagerBasedRlEnv(dataclasses.replace(cfg, scene=scene, events=calm, seed=3))
    check_env(env)
    env_state = env.reset()
    for _ in range(250):
        env_state["action"] = torch.zeros(env.action_spec.shape)
        env_state = env.step(env_state)["next"].exclude("reward")
        assert not env_state["done"].any()
    (robot,) = cfg.scene.robots.values()
    assert (env.view.root_pos_EL[:, 2] > 0.9 * robot.init_pos[2]).all()


def test_the_guides_stool_settles_although_its_joints_carry_little():
    # At 10 Hz its motors are so weak that it stands for 5 s with knees that have sunk by half a radian.
    found = analyse(guide.files("add_a_robot.md")["stool/stool.xml"])
    check_proposals(found, 4)
    assert found.mass == pytest.approx(5.7)
