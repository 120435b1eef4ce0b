"""Inertial measurement units on bodies that spin, rest and fall."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.envs import ImuSensor
from ksim_rl.mdp import ImuReading
from tests.scene.sensors.bench import SensorBench

GRAVITY = 9.81
SCENE = f"""
<mujoco>
  <option timestep="0.002" gravity="0 0 {-GRAVITY}" integrator="implicitfast"/>
  <worldbody>
    <body name="terrain"><geom name="terrain" type="plane" size="0 0 0.01"/></body>
    <body name="box" pos="0 0 0.1">
      <freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" mass="2"/>
      <site name="chip" pos="0.05 0 0" euler="0 0 90"/>
    </body>
    <body name="wheel" pos="2 0 1">
      <joint name="axle" axis="0 0 1"/><geom name="wheel" type="cylinder" size="0.2 0.05" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""
SENSORS = {
    "chip": ImuSensor(site="chip"),
    "body": ImuSensor(body="box"),
    "rim": ImuSensor(body="wheel", pos=(0.2, 0.0, 0.0)),
}
REST, AXLE = [0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], [0.0]


@pytest.fixture(scope="module")
def bench():
    return SensorBench(SCENE, 2, SENSORS)


def assert_reads(actual_EL, *expected, atol=1e-3):
    torch.testing.assert_close(
        actual_EL, torch.tensor(expected).expand_as(actual_EL), atol=atol, rtol=0
    )


def test_at_rest_the_accelerometer_reads_gravity_upwards(bench):
    bench.place(qpos=REST + AXLE, qvel=[0.0] * 7)
    for _ in range(30):
        bench.step()
    for name in ("chip", "body"):
        state = bench.view.imu(name)
        assert_reads(state.lin_acc_EL, 0.0, 0.0, GRAVITY, atol=0.02)
        assert_reads(state.ang_vel_EL, 0.0, 0.0, 0.0)
        assert_reads(state.projected_gravity_EL, 0.0, 0.0, -1.0)


def test_in_free_fall_the_accelerometer_reads_nothing(bench):
    bench.place(qpos=[0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0] + AXLE, qvel=[0.0] * 7)
    bench.step()
    assert_reads(bench.view.imu("chip").lin_acc_EL, 0.0, 0.0, 0.0)


def test_angular_velocity_and_gravity_are_in_the_axes_of_the_unit(bench):
    # The body is turned by 90 degrees about x (its z axis points to world -y), and spins about its own x and z.
    half = 0.5**0.5
    bench.place(
        qpos=[0.0, 0.0, 3.0, half, half, 0.0, 0.0] + AXLE, qvel=[0.0, 0.0, 0.0, 3.0, 0.0, 5.0, 0.0]
    )
    body, chip = bench.view.imu("body"), bench.view.imu("chip")
    assert_reads(body.ang_vel_EL, 3.0, 0.0, 5.0)
    assert_reads(body.projected_gravity_EL, 0.0, -1.0, 0.0)
    assert_reads(body.quat_EL, half, half, 0.0, 0.0)
    # The chip is turned by 90 degrees about the body's z: its x is the body's y, and its y the body's -x.
    assert_reads(chip.ang_vel_EL, 0.0, -3.0, 5.0)
    assert_reads(chip.projected_gravity_EL, -1.0, 0.0, 0.0)
    # World gravity, turned by the orientation that it reads, is what it reads.
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, chip.quat_EL[0].double().numpy())
    np.testing.assert_allclose(
        rotation.reshape(3, 3) @ chip.projected_gravity_EL[0].numpy(), (0, 0, -1), atol=1e-5
    )


def test_on_a_spinning_rim_it_reads_the_centripetal_acceleration(bench):
    speed = 4.0
    bench.place(qpos=REST + AXLE, qvel=[0.0] * 6 + [speed])
    bench.step(substeps=1)
    assert_reads(bench.view.imu("rim").lin_acc_EL, -(speed**2) * 0.2, 0.0, GRAVITY, atol=1e-3)
    assert_reads(bench.view.imu("rim").ang_vel_EL, 0.0, 0.0, speed)


def test_observations_name_the_quantity(bench):
    bench.place(qpos=REST + AXLE, qvel=[0.0] * 6 + [2.0])
    with bench.driver.scope("observations/x"):
        assert_reads(ImuReading(sensor="rim")(bench.view), 0.0, 0.0, 2.0)
        reading = ImuReading(sensor="body", quantity="projected_gravity")(bench.view)
    assert_reads(reading, 0.0, 0.0, -1.0)
    with pytest.raises(ValueError, match="quantity='speed'"):
        ImuReading(sensor="rim", quantity="speed")
    with pytest.raises(ValueError, match=r"no IMU 'rin' in scene\.sensors: did you mean 'rim'"):
        bench.view.imu("rin")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "site=None, body=None: give exactly one"),
        ({"site": "a", "body": "b"}, "give exactly one"),
        ({"site": "chip", "pos": (1.0, 0.0, 0.0)}, "pos=.*a site has its own place"),
        ({"body": "box", "pos": (float("nan"), 0.0, 0.0)}, r"pos\[0\]=nan"),
    ],
)
def test_settings_that_contradict_are_refused(fields, message):
    with pytest.raises(ValueError, match=message):
        ImuSensor(**fields)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (ImuSensor(site="chop"), r"scene\.sensors\.imu: no site 'chop': did you mean 'chip'"),
        (ImuSensor(body="bax"), r"scene\.sensors\.imu: no body 'bax': did you mean 'box'"),
    ],
)
def test_unknown_places_are_refused(sensor, message):
    with pytest.raises(ValueError, match=message):
        sensor.add_to(mujoco.MjSpec.from_string(SCENE), "imu")
