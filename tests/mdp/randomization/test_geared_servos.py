"""Gains and limits of servos are drawn at the joint, whatever gear, gain and offset the model has."""

import mujoco
import pytest

from ksim_rl import mdp
from ksim_rl.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg, MjcfRobot, SceneCfg
from ksim_rl.physics import SimCfg

HINGE = """
<mujoco><option gravity="0 0 0"/><worldbody>
<body><joint name="hinge" axis="0 1 0"/><geom size="0.1"/></body></worldbody>
<actuator>{actuator}</actuator></mujoco>
"""
AFFINE = 'name="a" joint="hinge" biastype="affine"'
SERVOS = {
    "plain": '<position name="a" joint="hinge" kp="50" kv="5" forcerange="-30 30"/>',
    "gear": '<position name="a" joint="hinge" kp="50" kv="5" gear="-2" forcerange="-30 30"/>',
    "0 to 255": f'<general {AFFINE} gainprm="0.4" biasprm="-7 -50 -5" gear="3" forcerange="-30 30"/>',
}


def varied(text: str, event) -> mujoco.MjModel:
    """Return the model of the first world."""
    scene = SceneCfg(robots={"r": MjcfRobot(source=text)})
    blank = {"observations": {}, "actions": {}, "rewards": {}, "terminations": {}}
    cfg = ManagerBasedRlEnvCfg(
        decimation=1, scene=scene, sim=SimCfg(engine="c"), events={"gains": event}, seed=0, **blank
    )
    env = ManagerBasedRlEnv(cfg)
    model = mujoco.MjModel.from_xml_string(text)
    for name in event.per_world_fields:
        value_E = env.world.field(name)
        getattr(model, name)[:] = value_E[0].numpy().reshape(getattr(model, name).shape)
    return model


def effort(model: mujoco.MjModel, *, ctrl: float, pos: float = 0.0, vel: float = 0.0) -> float:
    """Return what MuJoCo's C engine exerts on the joint."""
    data = mujoco.MjData(model)
    data.ctrl[0] = ctrl
    data.qpos[0] = pos
    data.qvel[0] = vel
    mujoco.mj_forward(model, data)
    return float(data.qfrc_actuator[0])


@pytest.mark.parametrize("kind", SERVOS)
def test_gains_are_those_of_the_joint_and_targets_mean_what_they_did(kind):
    text = HINGE.format(actuator=SERVOS[kind])
    own = mujoco.MjModel.from_xml_string(text)
    event = mdp.RandomizeActuatorGains(stiffness=(80.0, 80.0), damping=(3.0, 3.0), operation="abs")
    model = varied(text, event)
    own.actuator_forcelimited[:] = model.actuator_forcelimited[:] = 0
    # The control that rests at 0.2 rad in the file's own model, by its forces at two positions.
    at_0, at_1 = effort(own, ctrl=0.0), effort(own, ctrl=1.0)
    resting = -effort(own, ctrl=0.0, pos=0.2) / (at_1 - at_0)
    assert effort(model, ctrl=resting, pos=0.2) == pytest.approx(0.0, abs=1e-4)
    still = effort(model, ctrl=0.0)
    assert still - effort(model, ctrl=0.0, pos=0.1) == pytest.approx(8.0, rel=1e-5)
    assert still - effort(model, ctrl=0.0, vel=0.1) == pytest.approx(0.3, rel=1e-5)


@pytest.mark.parametrize("kind", SERVOS)
def test_limits_of_effort_are_those_of_the_joint(kind):
    text = HINGE.format(actuator=SERVOS[kind])
    model = varied(text, mdp.RandomizeEffortLimit(ranges=(11.0, 11.0), operation="abs"))
    assert abs(effort(model, ctrl=1e4)) == pytest.approx(11.0)
    assert abs(effort(model, ctrl=-1e4)) == pytest.approx(11.0)
    halved = varied(text, mdp.RandomizeEffortLimit(ranges=(0.5, 0.5), operation="scale"))
    own = mujoco.MjModel.from_xml_string(text)
    assert effort(halved, ctrl=1e4) == pytest.approx(0.5 * effort(own, ctrl=1e4))
