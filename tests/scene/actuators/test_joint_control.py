"""What the control of a joint's actuator means: targets at the joint, whatever gear, gain and bias the model has."""

import mujoco
import numpy as np
import pytest

from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, MjcfRobot, SceneCfg
from ksim_rl.mdp import JointEffortAction, JointPositionAction, JointVelocityAction
from ksim_rl.physics import SimCfg
from ksim_rl.scene.robots.proposal import effort_limit_of
from ksim_rl.scene.state.joint_control import effort_limit, force_limit, joint_control

HINGE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body><joint name="hinge" axis="0 1 0" damping="{damping}"/><geom size="0.1" mass="20"/></body>
  </worldbody>
  <actuator>{actuator}</actuator>
</mujoco>
"""
AFFINE = 'name="a" joint="hinge" biastype="affine"'
POSITION = {
    "plain": '<position name="a" joint="hinge" kp="50" kv="5"/>',
    "gear": '<position name="a" joint="hinge" kp="50" kv="5" gear="2"/>',
    "negative gear": '<position name="a" joint="hinge" kp="50" kv="5" gear="-0.5"/>',
    "0 to 255": f'<general {AFFINE} ctrlrange="0 255" gainprm="0.4" biasprm="0 -50 -5"/>',
    "constant": f'<general {AFFINE} gear="2" gainprm="10" biasprm="-4 -20 -3"/>',
    "filter": '<position name="a" joint="hinge" kp="50" kv="5" gear="2" timeconst="0.02"/>',
    "in parent": '<position name="a" jointinparent="hinge" kp="50" kv="5" gear="2"/>',
}
VELOCITY = {
    "plain": '<velocity name="a" joint="hinge" kv="20"/>',
    "gear": '<velocity name="a" joint="hinge" kv="20" gear="3"/>',
    "constant": f'<general {AFFINE} gear="2" gainprm="7" biasprm="1.5 0 -20"/>',
    "integrated": '<intvelocity name="a" joint="hinge" kp="90" kv="9" gear="2" actrange="-9 9"/>',
}
REFUSED = {
    "gain is not fixed": f'<general {AFFINE} gaintype="affine" gainprm="9 1" biasprm="0 -9"/>',
    "gain or gear is 0": f'<general {AFFINE} gainprm="0" biasprm="0 -9"/>',
    "pushes away": f'<general {AFFINE} biasprm="0 9"/>',
    "dynamics are muscle": f'<general {AFFINE} biasprm="0 -9" dyntype="muscle"/>',
    "integrates its control": f'<general {AFFINE} biasprm="0 0 -9" dyntype="integrator" actrange="-1 1"/>',
    "kind is muscle": '<muscle name="a" joint="hinge" lengthrange="-1 1"/>',
}


def hinge(actuator: str, damping: float = 0.0) -> str:
    return HINGE.format(actuator=actuator, damping=damping)


def make(text: str, action) -> ManagerBasedRlEnv:
    scene = SceneCfg(robots={"r": MjcfRobot(source=text)})
    blank = {"observations": {}, "rewards": {}, "terminations": {}}
    sim = SimCfg(engine="c", timestep=0.002)
    return ManagerBasedRlEnv(
        ManagerBasedRlEnvCfg(decimation=1, scene=scene, sim=sim, actions={"a": action}, **blank)
    )


def settled(text: str, ctrl: float, seconds: float = 4.0) -> mujoco.MjData:
    """Return where MuJoCo's C engine comes to rest under a control."""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.ctrl[:] = ctrl
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return data


@pytest.mark.parametrize("kind", POSITION)
def test_a_joint_stands_where_it_is_asked_to(kind):
    env = make(hinge(POSITION[kind]), JointPositionAction(joints="hinge"))
    env.reset()
    env.view.write_joint_pos_target("hinge", env.view.joint_pos_EL + 0.5)
    ctrl = float(env.world.ctrl_EL[0, 0])
    data = settled(hinge(POSITION[kind]), ctrl)
    assert float(data.qpos[0]) == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("kind", VELOCITY)
def test_a_joint_turns_as_fast_as_it_is_asked_to(kind):
    env = make(hinge(VELOCITY[kind]), JointVelocityAction(joints="hinge"))
    env.reset()
    env.view.write_joint_vel_target("hinge", env.view.joint_vel_EL + 0.8)
    data = settled(hinge(VELOCITY[kind]), float(env.world.ctrl_EL[0, 0]))
    assert float(data.qvel[0]) == pytest.approx(0.8, abs=1e-4)


@pytest.mark.parametrize("kind", POSITION)
def test_a_reset_lets_servos_hold_the_default_pose(kind):
    text = hinge(POSITION[kind]).replace(
        "</mujoco>", '<keyframe><key qpos="0.3"/></keyframe></mujoco>'
    )
    env = make(text, JointPositionAction(joints="hinge"))
    env.reset()
    for _ in range(50):
        env.world.step(10)
    assert float(env.world.qpos_EL[0, 0]) == pytest.approx(0.3, abs=1e-5)


@pytest.mark.parametrize("kind", ["gear", "0 to 255", "constant", "in parent"])
def test_stiffness_and_damping_are_what_the_joint_feels(kind):
    model = mujoco.MjModel.from_xml_string(hinge(POSITION[kind]))
    control = joint_control(model, 0)
    data = mujoco.MjData(model)
    efforts: list[float] = []
    for pos, vel in ((0.0, 0.0), (0.1, 0.0), (0.0, 0.1)):
        data.qpos[0] = pos
        data.qvel[0] = vel
        mujoco.mj_forward(model, data)
        efforts.append(float(data.qfrc_actuator[0]))
    assert control.stiffness == pytest.approx((efforts[0] - efforts[1]) / 0.1)
    assert control.damping == pytest.approx((efforts[0] - efforts[2]) / 0.1)


def test_the_control_of_a_plain_servo_is_its_target_bit_for_bit():
    env = make(hinge(POSITION["plain"]), JointPositionAction(joints="hinge", scale=0.37))
    tensordict = env.reset()
    tensordict["action"] = env.action_spec.rand()
    env.step(tensordict)
    assert env.world.ctrl_EL.equal(env.view.joint_pos_target_EL)


@pytest.mark.parametrize("why", REFUSED)
def test_controls_that_mean_no_target_are_refused_by_name(why):
    text = hinge(REFUSED[why])
    model = mujoco.MjModel.from_xml_string(text)
    kind = joint_control(model, 0).kind
    actions = {"pos": JointPositionAction, "vel": JointVelocityAction, "effort": JointEffortAction}
    with pytest.raises(ValueError, match=f"joint 'hinge' .* actuator 'a' .*{why}"):
        make(text, actions[kind](joints="hinge"))


def test_a_target_is_the_inverse_of_its_control():
    for text in (*POSITION.values(), *VELOCITY.values()):
        control = joint_control(mujoco.MjModel.from_xml_string(hinge(text)), 0)
        np.testing.assert_allclose(control.target(control.of(0.7)), 0.7, rtol=1e-12)


@pytest.mark.parametrize(
    "actuator",
    [
        '<motor name="a" joint="hinge" forcerange="-3 5" gear="2"/>',
        '<position name="a" joint="hinge" kp="50" forcerange="-7 4" gear="-3"/>',
        '<general name="a" joint="hinge" gainprm="4" ctrlrange="-0.5 2" ctrllimited="true" gear="3"/>',
        '<motor name="a" joint="hinge" ctrlrange="0 2" ctrllimited="true" gear="5"/>',
    ],
)
def test_limits_of_effort_are_those_that_mujoco_keeps_both_ways(actuator):
    mj_model = mujoco.MjModel.from_xml_string(hinge(actuator))
    mj_data = mujoco.MjData(mj_model)
    efforts = []
    for control in (-1e9, 1e9):
        mj_data.ctrl[0] = control
        mujoco.mj_forward(mj_model, mj_data)
        efforts.append(abs(mj_data.qfrc_actuator[0]))
    # A drive that acts one way only is limited by that way.
    least = min(effort for effort in efforts if effort > 0.0)
    assert effort_limit(mj_model, 0) == pytest.approx(least)
    assert effort_limit_of(mj_model, 0, most=1e6) == pytest.approx(least)
    if mj_model.actuator_forcelimited[0]:
        assert force_limit(mj_model, 0) == pytest.approx(least)
    else:
        assert force_limit(mj_model, 0) is None
