"""Drake's plant of a model moves as MuJoCo's C engine does; it is tested where Drake is installed."""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

from ksim_rl.scene.robots import Arm, Cartpole, Pendulum, Reacher

pytest.importorskip("pydrake", reason="needs Drake: pip install drake")
FILE = Path(__file__).parents[2] / "examples" / "simulators" / "in_drake.py"
SECONDS = 0.4


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("in_drake", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("robot", (Arm, Cartpole, Pendulum, Reacher))
def test_a_plant_moves_as_the_model(example, robot):
    spec = robot().spec()
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model = spec.compile()
    # Efforts alone: servos would hide what inertia does.
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0.0
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[:] += rng.uniform(-0.1, 0.1, model.nq)
    data.qvel[:] = rng.uniform(-1.0, 1.0, model.nv)
    mujoco.mj_forward(model, data)
    # About an acceleration of 5 rad/s^2 or m/s^2.
    effort = 5.0 * np.diag(_inertia(model, data)) * rng.choice((-1.0, 1.0), model.nv)
    plant = example.Plant(model)
    plant.place(data.qpos, data.qvel)
    start = data.qpos.copy()
    data.qfrc_applied[:] = effort
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        for _ in range(example.FINER):
            plant.step(effort)
    pos, vel = plant.state()
    assert np.abs(data.qpos - start).min() > 0.05
    assert pos == pytest.approx(data.qpos, abs=2e-3)
    assert vel == pytest.approx(data.qvel, abs=1e-2)


LEGS = """
<mujoco>
  <option timestep="0.001" integrator="RK4"/>
  <default><geom friction="0.6"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" priority="-1" friction="1"/>
    <body name="trunk" pos="0 0 0.5">
      <freejoint/>
      <geom type="box" size="0.2 0.15 0.05" mass="4" contype="0" conaffinity="0"/>
      <geom type="sphere" size="0.03" pos="0.4 0.2 -0.2" mass="0.1" contype="0"/>
      <geom type="sphere" size="0.03" pos="0.4 -0.2 -0.2" mass="0.1" contype="0"/>
      <geom type="sphere" size="0.03" pos="-0.4 0 -0.2" mass="0.1" contype="0"/>
      <body name="arm" pos="0 0 0.05">
        <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.02"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0.2" mass="0.5" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


def moved(example, model, data, seconds):
    """Let Drake and MuJoCo move a model from the same state, and return Drake's positions and velocities."""
    plant = example.Plant(model)
    plant.place(data.qpos, data.qvel)
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        for _ in range(example.FINER):
            plant.step(np.zeros(model.nv))
    return plant.state()


def test_a_free_robot_tumbles_as_in_mujoco(example):
    model = mujoco.MjModel.from_xml_string(LEGS)
    data = mujoco.MjData(model)
    data.qpos[2:7] = (3.0, 0.8, 0.0, 0.6, 0.0)
    data.qvel[:] = (1.0, -0.5, 2.0, 2.0, -1.0, 3.0, 4.0)
    pos, vel = moved(example, model, data, 0.4)
    assert pos == pytest.approx(data.qpos, abs=2e-3)
    assert vel == pytest.approx(data.qvel, abs=1e-2)


@pytest.mark.parametrize(("slope", "slides"), [(0.4, False), (1.0, True)])
def test_a_free_robot_stands_and_slides_on_the_ground_as_friction_says(example, slope, slides):
    model = mujoco.MjModel.from_xml_string(LEGS)
    # The floor is level, and gravity is not: tan(slope) is the force along it by the force into it.
    model.opt.gravity[:] = (9.81 * slope, 0.0, -9.81)
    data = mujoco.MjData(model)
    # Feet are at -0.23 m.
    data.qpos[2] = 0.2301
    data.qpos[7] = -0.5
    plant = example.Plant(model)
    plant.place(data.qpos, data.qvel)
    for _ in range(300 * example.FINER):
        # The arm hangs on a stiff motor.
        pos, vel = plant.state()
        effort = np.zeros(model.nv)
        effort[6] = -20.0 * (pos[7] + 0.5) - 0.5 * vel[6]
        plant.step(effort)
    pos, vel = plant.state()
    assert pos[2] == pytest.approx(0.23, abs=2e-3)
    if slides:
        # After 0.3 s by what friction leaves of the pull; its coefficient is the foot's, by the floor's priority.
        assert vel[0] == pytest.approx(9.81 * (slope - 0.6) * 0.3, rel=0.1)
    else:
        assert abs(vel[0]) < 0.02 and abs(pos[0]) < 0.01


def test_ground_that_is_not_flat_is_refused(example):
    field = '<asset><hfield name="a" nrow="2" ncol="2" size="1 1 1 1"/></asset>'
    ground = '<geom type="hfield" hfield="a"/>'
    text = LEGS.replace("<worldbody>", f"{field}<worldbody>{ground}")
    with pytest.raises(ValueError, match="robot.xml has uneven ground"):
        example.Plant(mujoco.MjModel.from_xml_string(text))


def _inertia(model, data):
    dense = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, dense)
    return dense


def test_what_drake_does_not_get_is_refused(example):
    spec = Arm().spec()
    spec.joints[0].frictionloss = 0.1
    with pytest.raises(ValueError, match=r"robot.xml has dry friction"):
        example.Plant(spec.compile())
