"""Sensors of joint and tendon limits, beside the C engine, after substeps and after a refresh."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World
from tests.physics.beside_c import ALL_KERNELS, KERNELS, THEIRS, step_and_check

# Joint 0 and tendon 0 are both limited, and so are both sides of a slide with a wide margin.
LIMITED = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" integrator="implicitfast"><flag {flags}/></option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint name="hinge" axis="0 1 0" range="-0.1 0.1" limited="true" margin="0.05" damping="0.1"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
      <body pos="0 0 -0.3"><joint name="ball" type="ball" range="0 0.2" limited="true" margin="0.05" damping="0.1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.4"/></body>
    </body>
    <body pos="1 0 0"><joint name="slide" type="slide" axis="0 0 1" range="-0.3 0.001" limited="true" margin="0.02"/>
      <geom size="0.1" mass="1"/></body>
  </worldbody>
  {tendon}
  <sensor>
    <jointlimitpos joint="hinge"/><jointlimitvel joint="hinge"/><jointlimitfrc joint="hinge"/>
    <jointlimitpos joint="ball"/><jointlimitvel joint="ball"/><jointlimitfrc joint="ball"/>
    <jointlimitpos joint="slide" cutoff="0.01"/><jointlimitvel joint="slide"/><jointlimitfrc joint="slide" cutoff="5"/>
    <e_kinetic/><e_potential/>
    {sensors}
  </sensor>
</mujoco>
"""
TENDON = """
<tendon>
  <fixed name="rope" range="-0.05 0.05" limited="true" margin="0.02" damping="0.1">
    <joint joint="hinge" coef="1"/><joint joint="slide" coef="2"/></fixed>
</tendon>"""
OF_TENDON = (
    '<tendonlimitpos tendon="rope"/><tendonlimitvel tendon="rope"/><tendonlimitfrc tendon="rope"/>'
)


@pytest.mark.parametrize("kernels", ALL_KERNELS)
def test_limits_of_joints_read_as_in_c(kernels: str) -> None:
    step_and_check(LIMITED.format(flags="", tendon="", sensors=""), KERNELS[kernels])


@pytest.mark.parametrize("kernels", ("our solver", THEIRS))
def test_a_tendon_is_not_taken_for_the_joint_of_its_number(kernels: str) -> None:
    step_and_check(LIMITED.format(flags="", tendon=TENDON, sensors=OF_TENDON), KERNELS[kernels])


@pytest.mark.parametrize("flags", ('limit="disable"', 'constraint="disable"', 'sensor="disable"'))
def test_without_limits_or_sensors_they_read_zero(flags: str) -> None:
    step_and_check(
        LIMITED.format(flags=flags, tendon=TENDON, sensors=OF_TENDON), KERNELS["our solver"]
    )


def test_a_refresh_reads_the_pose_that_was_written() -> None:
    mj_model = mujoco.MjModel.from_xml_string(LIMITED.format(flags="", tendon="", sensors=""))
    world = World(mj_model, num_envs=1, sim=SimCfg(one_kernel_dynamics=True))
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[0] = 0.25
    world.qpos_EL.copy_(torch.from_numpy(mj_data.qpos).float())
    world.refresh()
    mujoco.mj_forward(mj_model, mj_data)
    assert mj_data.sensordata[0] == pytest.approx(-0.2)
    np.testing.assert_allclose(world.sensordata_EL[0, 0].item(), mj_data.sensordata[0], atol=1e-6)
