"""Rows of connect and weld weigh the bodies that they tie, such as tool frames, which have no joints of their own."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

ARMS = """
<mujoco>
  <option timestep="0.002" jacobian="{jacobian}">{flag}</option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="post" pos="0 0 1"><geom size=".02"/><site name="hook" pos=".1 0 0"/></body>
    <body name="arm" pos="0 .3 1">
      <joint name="elbow" axis="0 1 0" damping=".1"/><joint name="twist" axis="1 0 0" damping=".1"/>
      <geom type="capsule" size=".02" fromto="0 0 0 .4 0 0" mass="1"/>
      <body name="palm" pos=".4 0 0"><geom size=".03" mass=".2"/>
        <body name="tool" pos=".2 0 0"><geom size=".01" mass=".01"/><site name="tip" pos=".05 0 0"/></body>
      </body>
    </body>
    <body name="load" pos=".6 .3 .9"><freejoint/><geom size=".05" mass=".3"/>
      <body name="handle" pos="0 0 .1"><geom size=".01" mass=".02"/><site name="grip"/></body>
    </body>
    <body name="twin" pos=".1 -.3 1"><freejoint/><geom type="box" size=".05 .03 .1" mass=".5"/>
      <body name="fin" pos=".1 0 0"><geom size=".02" mass=".01"/></body>
    </body>
  </worldbody>
  <equality>{ties}</equality>
</mujoco>
"""
TIES = {
    "connect": '<connect body1="tool" body2="handle" anchor="0 0 0"/>',
    "connect of sites": '<connect site1="tip" site2="grip"/>',
    "weld": '<weld body1="handle" body2="tool"/><connect body1="fin" body2="palm" anchor=".1 0 0"/>',
    "weld of sites": '<weld site1="tip" site2="grip"/><weld body1="fin"/>',
    "with others": (
        '<joint joint1="elbow" joint2="twist"/><weld body1="load" body2="palm"/><weld body1="tool" body2="fin"/>'
    ),
}
OURS, THEIRS = (
    SimCfg(one_kernel_dynamics=True, njmax=40, nconmax=4),
    SimCfg(one_kernel_dynamics=False, njmax=40),
)
NO_KERNEL = SimCfg(one_kernel_solver=False, njmax=40, nconmax=4)


def compare(xml: str, sim: SimCfg) -> None:
    """Compare rows and the state after a step with the C engine's."""
    world = World(load_model(xml), num_envs=2, sim=sim)
    torch.manual_seed(0)
    world.qpos_EL[1] += 0.05 * torch.randn(world.qpos_EL[1].shape)
    world.qvel_EL[1] = 3.0 * torch.randn(world.qvel_EL[1].shape)
    mj_data = mujoco.MjData(world.mj_model)
    before = [tensor[1].numpy().astype(np.float64) for tensor in (world.qpos_EL, world.qvel_EL)]
    world.step(1)
    mj_data.qpos[:], mj_data.qvel[:] = before
    mujoco.mj_step(world.mj_model, mj_data)
    if sim.integrator != "rk4":  # whose last stage is another in our data
        # MuJoCo Warp makes rows of connect before rows of weld.
        order = world.last_substep("efc.id")[1, : mj_data.nefc].argsort(stable=True)
        np.testing.assert_allclose(world.last_substep("efc.D")[1, order], mj_data.efc_D, rtol=1e-3)
    np.testing.assert_allclose(world.qvel_EL[1], mj_data.qvel, rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize(
    "sim",
    [OURS, THEIRS, pytest.param(NO_KERNEL, marks=pytest.mark.full)],
    ids=("ours", "theirs", "their solver"),
)
@pytest.mark.parametrize("ties", TIES.values(), ids=TIES)
def test_tied_bodies_without_joints_weigh_as_in_the_c_engine(ties, sim):
    compare(ARMS.format(ties=ties, flag="", jacobian="sparse"), sim)


@pytest.mark.parametrize(
    "changes",
    [{"integrator": "rk4"}, {"integrator": "discrete"}, {"solver": "cg", "iterations": 200}],
)
@pytest.mark.parametrize(
    "flag",
    [
        "",
        '<flag spring="disable" damper="disable"/>',
        '<flag spring="disable" damper="disable" actuation="disable"/>',
    ],
    ids=("passive", "control", "idle control"),
)
def test_so_they_do_within_steps_that_are_mujoco_warps_own(flag, changes):
    xml = ARMS.format(ties=TIES["weld"], flag=flag, jacobian="sparse")
    compare(xml, SimCfg(njmax=40, nconmax=4, **changes))
