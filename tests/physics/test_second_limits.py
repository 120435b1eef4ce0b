"""Both limits of a joint or tendon hold where its range is narrower than twice their margin; C makes a row of each."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

XML = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.004" jacobian="sparse"/>
  <worldbody>
    <body pos="0 0 1">
      <joint name="swing" axis="0 1 0" range="-.02 .03" limited="true" margin=".1" damping=".1"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0" mass="1"/>
      <body pos=".3 0 0">
        <joint name="rail" type="slide" axis="1 0 0" range="-.05 .1" limited="true" margin=".1" solreflimit=".03 1"/>
        <geom size=".05" mass=".3"/>
      </body>
    </body>
    <body pos="0 1 .095"><freejoint/><geom size=".1" mass="1"/></body>
  </worldbody>
  {more}
</mujoco>
"""
TENDON = """
<tendon><fixed name="strap" limited="true" range="-.04 .02" margin=".08">
  <joint joint="swing" coef="1"/><joint joint="rail" coef="-.7"/>
</fixed></tendon>
"""
SENSORS = '<sensor><jointlimitpos joint="swing"/><jointlimitvel joint="rail"/><jointlimitfrc joint="swing"/></sensor>'
OURS, THEIRS = (
    SimCfg(one_kernel_dynamics=True, njmax=40),
    SimCfg(one_kernel_dynamics=False, njmax=40),
)
DENSE = SimCfg(one_kernel_solver=False, njmax=40)


def compare(world: World, mj_model: mujoco.MjModel, row: int) -> None:
    """Step one world's state in C too, and compare the rows of that step and where it leads."""
    mj_data = mujoco.MjData(mj_model)
    mj_data.qpos[:], mj_data.qvel[:] = world.qpos_EL[row], world.qvel_EL[row]
    world.step(1)
    mujoco.mj_step(mj_model, mj_data)
    assert int(world.last_substep("nefc")[row]) == mj_data.nefc
    assert mj_data.nefc > len({*zip(mj_data.efc_type, mj_data.efc_id, strict=True)})
    found = world.last_substep("efc.D")[row, : mj_data.nefc].sort().values
    np.testing.assert_allclose(found, np.sort(mj_data.efc_D), rtol=1e-4)
    np.testing.assert_allclose(world.qvel_EL[row], mj_data.qvel, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        world.view("sensordata")[row], mj_data.sensordata, rtol=1e-3, atol=1e-3
    )


def thrown(
    num_envs: int, sim: SimCfg, *, more: str = "", jacobian: str = "sparse", fields: tuple = ()
) -> World:
    xml = XML.format(more=more).replace("sparse", jacobian)
    world = World(load_model(xml), num_envs=num_envs, sim=sim, per_world_fields=fields)
    torch.manual_seed(0)
    world.qpos_EL[:, :2] = 0.015 * torch.randn(num_envs, 2)
    world.qvel_EL.copy_(torch.randn(world.qvel_EL.shape))
    return world


@pytest.mark.parametrize("more", ["", TENDON, SENSORS], ids=("joints", "tendon", "sensors"))
@pytest.mark.parametrize(
    ("sim", "jacobian"),
    [
        (OURS, "sparse"),
        (THEIRS, "sparse"),
        pytest.param(DENSE, "sparse", marks=pytest.mark.full),
        (DENSE, "dense"),
    ],
    ids=("ours", "theirs", "their solver", "dense"),
)
def test_both_limits_hold(sim, jacobian, more):
    world = thrown(2, sim, more=more, jacobian=jacobian)
    for row in range(2):
        compare(world, world.mj_model, row)


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize("sim", [OURS, THEIRS], ids=("ours", "theirs"))
def test_ranges_of_a_world_may_be_narrower_than_those_of_the_model(sim, num_envs):
    wide = XML.replace("-.02 .03", "-1 1").replace("-.05 .1", "-1 1")
    world = World(
        load_model(wide.format(more="")),
        num_envs=num_envs,
        sim=sim,
        per_world_fields=("jnt_range",),
    )
    world.field("jnt_range")[-1, :2] = torch.tensor([[-0.02, 0.03], [-0.05, 0.1]])
    narrow = load_model(XML.format(more=""))
    compare(world, narrow, num_envs - 1)
    if num_envs > 1:
        assert int(world.last_substep("nl")[0]) == 0


def test_rows_without_room_are_counted():
    world = thrown(1, SimCfg(one_kernel_dynamics=False, njmax=2, nconmax=4))
    world.step(1)
    assert "njmax" in " ".join(world.overflow_report().messages)
