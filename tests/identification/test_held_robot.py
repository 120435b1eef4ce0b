"""Robots are held: their numbers as their files have them, their limbs each alone."""

import mujoco
import numpy as np
import pytest

from ksim_rl.identification.held_robot import hold
from tests.absent_models import skipped_without_models
from tests.identification import hidden


def test_a_robot_of_explicit_motors_keeps_its_gains_and_limits():
    with skipped_without_models():
        robot = hold("go2")
    assert len(robot.limbs()) == 4 and robot.mj_model.nv == 12
    calf = robot.joints[robot.joint_names.index("RL_calf_joint")]
    assert calf.nominal["stiffness"] == 30.0 and calf.nominal["servo_damping"] == 1.0
    assert calf.nominal["armature"] == 0.01 and calf.effort_limit == 45.43
    assert calf.takes == {"pos", "vel", "effort"} and calf.rest == -1.8


def test_a_geared_servo_counts_at_the_joint(tmp_path):
    path = tmp_path / "leg.xml"
    path.write_text(hidden.MODEL.replace('<position name="hip"', '<position name="hip" gear="3"'))
    hip, knee = hold(str(path)).joints
    assert (hip.nominal["stiffness"], hip.nominal["servo_damping"]) == pytest.approx((180.0, 5.4))
    assert hip.effort_limit == 45.0 and knee.effort_limit == 15.0
    assert (hip.rest, knee.rest) == (0.3, -0.8)


def test_a_limb_alone_moves_as_in_the_whole_robot():
    robot = hold("quadruped")
    whole, limb = robot.mj_model, robot.limbs()[2]
    rng = np.random.default_rng(0)
    data, alone = mujoco.MjData(whole), mujoco.MjData(limb.mj_model)
    data.qpos[:], data.qvel[:] = rng.uniform(-0.3, 0.3, whole.nq), rng.uniform(-1.0, 1.0, whole.nv)
    own = [whole.joint(name).qposadr[0] for name in limb.joint_names]
    alone.qpos[:], alone.qvel[:] = data.qpos[own], data.qvel[own]
    mujoco.mj_forward(whole, data)
    mujoco.mj_forward(limb.mj_model, alone)
    assert len(own) == 3 and alone.qacc == pytest.approx(data.qacc[own], rel=1e-9)


def test_the_base_is_turned_as_told(tmp_path):
    path = tmp_path / "leg.xml"
    path.write_text(hidden.MODEL)
    model = hold(str(path), quat=(0.0, 1.0, 0.0, 0.0)).mj_model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    # Upside down: the leg points upwards.
    assert data.body("shank").xpos[2] == pytest.approx(1.2)


def test_robots_that_cannot_be_identified_are_named(tmp_path):
    with pytest.raises(ValueError, match="--robot goo: did you mean 'go"):
        hold("goo")
    path = tmp_path / "leg.xml"
    path.write_text(
        hidden.MODEL.replace('<position name="knee"', '<position name="two" joint="hip"/><position')
    )
    with pytest.raises(ValueError, match="joint 'hip' has 2 actuators"):
        hold(str(path))
    actuators = hidden.MODEL[hidden.MODEL.index("<actuator>") : hidden.MODEL.index("<keyframe>")]
    path.write_text(hidden.MODEL.replace(actuators, ""))
    with pytest.raises(ValueError, match="no joint of it has a motor"):
        hold(str(path))
