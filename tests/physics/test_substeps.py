"""Sensors that refresh must recompute, and those that it must leave alone."""

import functools

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, load_model
from tests.physics.beside_c import KERNELS, check, started
from tests.physics.models import forwarded, sensor

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.01"/>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" contype="0" conaffinity="0"/>
    <geom name="post" type="sphere" size="0.05" pos="0.6 0 1" contype="0" conaffinity="0"/>
    <body name="arm" pos="0 0 1">
      <joint name="pivot" axis="0 1 0" range="-2 2" limited="true" damping="0.1"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="1" contype="0" conaffinity="0"/>
      <geom name="ball" type="sphere" pos="0.4 0 0" size="0.05" mass="0.2" contype="0" conaffinity="0"/>
      <site name="eye" pos="0.4 0 -0.1" euler="3.14159 0 0"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cable"><joint joint="pivot" coef="2"/></fixed>
  </tendon>
  <actuator>
    <motor name="torque" joint="pivot" gear="3"/>
  </actuator>
  <sensor>
    <rangefinder name="height" site="eye"/>
    <tendonvel name="cable_vel" tendon="cable"/>
    <actuatorvel name="torque_vel" actuator="torque"/>
    <distance name="gap" geom1="ball" geom2="post" cutoff="2"/>
    <jointlimitpos name="room" joint="pivot"/>
    <jointpos name="late" joint="pivot" nsample="10" delay="0.03"/>
    <jointpos name="present" joint="pivot"/>
  </sensor>
</mujoco>
"""
REFRESHED = ("height", "cable_vel", "torque_vel", "present")
LEFT_ALONE = ("gap", "room", "late")


@functools.cache
def pendulum() -> mujoco.MjModel:
    return load_model(PENDULUM)


def swinging() -> World:
    world = World(pendulum(), num_envs=3, sim=SimCfg(njmax=8, nconmax=8))
    world.qpos_EL[:, 0] = torch.tensor([0.1, 0.3, -0.2])
    world.qvel_EL[:, 0] = 2.0
    for _ in range(4):
        world.step(4)
    return world


def test_refreshed_sensors_are_those_of_the_c_engine():
    world = swinging()
    world.refresh()
    for row in range(3):
        expected = forwarded(world, row)
        for name in REFRESHED:
            columns = sensor(world, name)
            np.testing.assert_allclose(
                world.sensordata_EL[row, columns],
                expected.sensordata[columns],
                atol=1e-5,
                err_msg=name,
            )


@pytest.mark.parametrize("kernels", ("ours", "our solver"))
@pytest.mark.parametrize("flag", ("", '<flag sensor="disable"/>'))
def test_momenta_of_subtrees_are_there_with_and_without_sensors(flag: str, kernels: str):
    xml = f"""
<mujoco>
  <option>{flag}</option>
  <worldbody><body name="b"><joint axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/></body></worldbody>
  <sensor><subtreeangmom body="b"/></sensor>
</mujoco>
"""
    world, mj_data, in_c = started(xml, KERNELS[kernels])
    names = ("subtree_linvel", "subtree_angmom")
    for name in names:
        world.view(name)
    world.refresh()
    mujoco.mj_fwdPosition(in_c, mj_data)
    mujoco.mj_fwdVelocity(in_c, mj_data)
    mujoco.mj_subtreeVel(in_c, mj_data)
    check(world, mj_data, names)


def test_sensors_that_read_the_last_collision_pass_are_left_alone():
    world = swinging()
    before = world.sensordata_EL.clone()
    assert (before[:, sensor(world, "gap")] < 2.0).all()
    world.reset(torch.tensor([True, False, False]))
    world.refresh()
    for name in LEFT_ALONE:
        columns = sensor(world, name)
        assert torch.equal(world.sensordata_EL[1:, columns], before[1:, columns]), name
        assert world.sensordata_EL[0, columns].abs().max() == 0, name


def test_a_delayed_sensor_samples_every_substep():
    world = swinging()
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(world.mj_model)
        m.opt.warn_overflow = 0
        d = mjw.make_data(world.mj_model, nworld=3, nconmax=8, njmax=8)
        wp.to_torch(d.qpos)[:, 0] = torch.tensor([0.1, 0.3, -0.2])
        wp.to_torch(d.qvel).fill_(2.0)
        for _ in range(16):
            mjw.step(m, d)
    late, present = sensor(world, "late"), sensor(world, "present")
    assert torch.equal(world.sensordata_EL[:, late], wp.to_torch(d.sensordata)[:, late])
    assert not torch.equal(world.sensordata_EL[:, late], world.sensordata_EL[:, present])


SPINNING_TIES = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="one"><joint axis="0 1 0"/><geom type="capsule" size="0.02" fromto="0 0 0 0.5 0 0" contype="0"/></body>
    <body name="two" pos="0.5 0 0">
      <freejoint/><geom type="capsule" size="0.02" fromto="0 0 0 0.5 0.1 0" contype="0"/>
    </body>
  </worldbody>
  <equality><{tie}/></equality>
</mujoco>
"""


CONNECT, WELD = 'connect body1="one" body2="two" anchor="0.5 0 0"', 'weld body1="one" body2="two"'


@pytest.mark.parametrize(
    ("tie", "one_kernel_solver"),
    [
        (CONNECT, True),
        (WELD, False),
        pytest.param(CONNECT, False, marks=pytest.mark.full),
        pytest.param(WELD, True, marks=pytest.mark.full),
    ],
)
def test_ties_of_fast_bodies_follow_the_c_engine(tie, one_kernel_solver):
    mj_model = load_model(SPINNING_TIES.format(tie=tie))
    world = World(
        mj_model, num_envs=1, sim=SimCfg(one_kernel_solver=one_kernel_solver, tolerance=1e-8)
    )
    mj_data = mujoco.MjData(mj_model)
    qvel = np.array([8.0, 0.0, 0.0, -4.0, 0.0, 8.0, 1.0])
    mj_data.qvel[:] = qvel
    world.qvel_EL[0] = torch.from_numpy(qvel)
    world.step(20)
    for _ in range(20):
        mujoco.mj_step(mj_model, mj_data)
    np.testing.assert_allclose(world.qpos_EL[0], mj_data.qpos, atol=2e-5)
