"""What is proposed keeps the robot inside of its limits and off itself, in its own files' physics."""

import mujoco
import numpy as np
import pytest

from ksim_rl.identification.excitation import propose
from ksim_rl.identification.held_robot import hold
from ksim_rl.scene.robots import UnitreeGo2
from tests.absent_models import skipped_without_models
from tests.identification import hidden


def test_a_quadruped_is_moved_widely_and_harmlessly():
    with skipped_without_models():
        robot = hold("go2")
    plan = propose(robot, ("pos", "vel", "effort"), seconds=5.0)
    again = propose(robot, ("pos", "vel", "effort"), seconds=5.0)
    assert all((plan.by_kind[kind] == again.by_kind[kind]).all() for kind in plan.by_kind)
    # The robot's own model with its PD motors, and its contacts.
    spec = UnitreeGo2().spec()
    spec.delete(spec.joints[0])
    for key in list(spec.keys):
        spec.delete(key)
    spec.option.timestep = 0.001
    model = spec.compile()
    data = mujoco.MjData(model)
    limits_N = np.array([joint.effort_limit for joint in robot.joints])
    address_N = [model.joint(name).qposadr[0] for name in robot.joint_names]
    motor_N = [model.actuator(name).id for name in robot.joint_names]
    data.qpos[address_N] = plan.by_kind["pos"][0]
    seen, most, contacts = [], 0.0, 0
    for step in range(2 * len(plan.time_T)):
        asked = {kind: values_TN[step // 2] for kind, values_TN in plan.by_kind.items()}
        effort_N = asked["effort"] + 30.0 * (asked["pos"] - data.qpos[address_N])
        effort_N = effort_N + 1.0 * (asked["vel"] - data.qvel[address_N])
        data.ctrl[motor_N] = effort_N
        mujoco.mj_step(model, data)
        seen.append(data.qpos[address_N].copy())
        most = max(most, np.abs(effort_N / limits_N).max())
        contacts += data.ncon
    low_N, high_N = model.jnt_range[[model.joint(name).id for name in robot.joint_names]].T
    assert (np.min(seen, axis=0) > low_N).all() and (np.max(seen, axis=0) < high_N).all()
    assert 0.1 < most < 0.7 and contacts == 0
    assert np.ptp(seen, axis=0).min() > 0.3


@pytest.mark.full
def test_a_robot_that_cannot_be_moved_is_said(tmp_path):
    path = tmp_path / "leg.xml"
    # The servo cannot carry the leg.
    path.write_text(
        hidden.MODEL.replace('mass="0.8"', 'mass="80"').replace('range="-1.2 1.2"', 'range="1 1.2"')
    )
    with pytest.raises(ValueError, match="even small motions reach a limit: joint 'hip'"):
        propose(hold(str(path)), ("pos",), seconds=5.0)
