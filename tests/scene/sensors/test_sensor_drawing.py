"""What sensors draw, noted by a visualizer that needs no OpenGL."""

import numpy as np
import pytest

from ksim_rl.envs import CameraSensor, ContactSensor, ImuSensor
from tests.scene.sensors.bench import SensorBench

SCENE = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -10"/>
  <statistic meanmass="4"/>
  <visual><map force="0.01"/></visual>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 0.01"/></body>
    <body name="box" pos="1 2 0.1" euler="0 0 90">
      <freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" mass="3"/>
    </body>
  </worldbody>
</mujoco>
"""
SENSORS = {
    "feet": ContactSensor(geoms=("box",)),
    "imu": ImuSensor(body="box", pos=(0.1, 0.0, 0.0)),
    "eye": CameraSensor(body="box", pos=(0.0, 0.0, 0.5), width=4, height=4),
}


class Recorder:
    """A visualizer that notes arrows and frames."""

    def __init__(self):
        self.arrows, self.frames = [], []

    def arrow(self, start, end, **_):
        self.arrows.append((start, end))

    def frame(self, origin, rotation, **_):
        self.frames.append((origin, rotation))


@pytest.fixture(scope="module")
def bench():
    bench = SensorBench(SCENE, 2, SENSORS)
    for _ in range(20):
        bench.step()
    # World 1 is lifted off the ground.
    raised_EL = bench.world.qpos_EL.clone()
    raised_EL[1, 2] = 1.0
    bench.place(qpos=raised_EL)
    bench.step()
    return bench


def drawn(bench, name, env_index):
    recorder = Recorder()
    bench.view.sensors[name].draw_debug(bench.view, recorder, env_index)
    return recorder


def test_contacts_are_arrows_of_the_force_on_the_element(bench):
    ((start, end),) = drawn(bench, "feet", 0).arrows
    np.testing.assert_allclose(start, (1.0, 2.0, 0.0), atol=2e-3)
    # 30 N at 0.01 m per newton and kilogram of mean mass.
    np.testing.assert_allclose(end - start, (0.0, 0.0, 30.0 * 0.01 / 4.0), atol=1e-4)
    assert drawn(bench, "feet", 1).arrows == [], "in the air there is none"


def test_units_and_cameras_are_frames(bench):
    ((origin, rotation),) = drawn(bench, "imu", 0).frames
    np.testing.assert_allclose(origin, (1.0, 2.1, 0.1), atol=2e-3)
    np.testing.assert_allclose(rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-3)
    ((origin, rotation),) = drawn(bench, "eye", 1).frames
    np.testing.assert_allclose(origin[:2], (1.0, 2.0), atol=2e-3)
    # It looks along the body's x, which is world y: its third axis points back.
    np.testing.assert_allclose(rotation[:, 2], (0, -1, 0), atol=1e-3)
