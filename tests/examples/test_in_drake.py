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


def _inertia(model, data):
    dense = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, dense)
    return dense


def test_what_drake_does_not_get_is_refused(example):
    spec = Arm().spec()
    spec.joints[0].frictionloss = 0.1
    with pytest.raises(ValueError, match=r"robot.xml has dry friction"):
        example.Plant(spec.compile())
