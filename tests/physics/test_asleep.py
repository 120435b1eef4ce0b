"""Where trees may sleep, what is read of a substep is the substep's, as in C."""

from typing import Literal

import mujoco
import pytest

from ksim_rl.physics import SimCfg, World
from ksim_rl.physics.warp_world import WarpWorld
from tests.physics.beside_c import KERNELS, step_and_check

XML = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}"><flag sleep="enable"/></option>
  <worldbody>
    <body><joint name="h" axis="0 1 0" damping="0.5" stiffness="2"/>
      <geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.3"/><site name="s" pos="0 0 -0.3"/>
    </body>
  </worldbody>
  <actuator><motor joint="h" gear="3"/></actuator>
  <sensor><force site="s"/></sensor>
</mujoco>
"""
READ = ("qpos", "qvel", "qacc", "qfrc_passive", "actuator_velocity", "cacc", "cfrc_int")


@pytest.mark.parametrize("integrator", ("Euler", "implicitfast"))
def test_a_substep_is_read_as_in_c(integrator: str) -> None:
    step_and_check(XML.format(integrator=integrator), KERNELS["theirs"], substeps=3, names=READ)


def test_worlds_without_rows_start_from_no_force() -> None:
    xml = XML.format(integrator="Euler").replace("<option", '<option jacobian="sparse"')
    mj_model = mujoco.MjModel.from_xml_string(xml)
    world = WarpWorld(mj_model, num_envs=1, sim=SimCfg(engine="warp"))
    world.qvel_EL[:] = 1.0
    # What the memory may have held when MuJoCo Warp took it, unwritten.
    world.warp_data_E.cqfrc_constraint.fill_(float("nan"))
    world.step(1)
    mj_data = mujoco.MjData(mj_model)
    mj_data.qvel[:] = 1.0
    mujoco.mj_step(mj_model, mj_data)
    assert world.qvel_EL.item() == pytest.approx(mj_data.qvel[0], rel=1e-5)
    assert world.view("qfrc_constraint").item() == 0.0


@pytest.mark.parametrize("engine", ("warp", "c"))
def test_equalities_of_tendons_are_refused_where_trees_may_sleep(engine: Literal["warp", "c"]):
    xml = """
<mujoco>
  <option><flag sleep="enable"/></option>
  <worldbody><body><joint name="j" type="slide"/><geom size="0.1"/></body></worldbody>
  <tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
  <equality><tendon name="tie" tendon1="t"/></equality>
</mujoco>
"""
    with pytest.raises(ValueError, match="equality 'tie' ties tendons.*leave out one of the two"):
        World(mujoco.MjModel.from_xml_string(xml), num_envs=1, sim=SimCfg(engine=engine))


@pytest.mark.parametrize("tolerance", ("1e-9", pytest.param("0.05", marks=pytest.mark.full), "0.2"))
def test_trees_fall_asleep_as_in_c(tolerance: str):
    xml = f"""
<mujoco>
  <option timestep="0.004" sleep_tolerance="{tolerance}"><flag sleep="enable"/></option>
  <worldbody>
    <body><joint name="alone" axis="0 1 0" damping="0.03"/><geom type="capsule" size="0.03 0.1"/></body>
    <body pos="1 0 0"><joint name="driven" axis="0 1 0" damping="0.3"/><geom type="capsule" size="0.03 0.1"/></body>
  </worldbody>
  <actuator><motor joint="driven"/></actuator>
</mujoco>
"""
    mj_model = mujoco.MjModel.from_xml_string(xml)
    mj_data = mujoco.MjData(mj_model)
    mj_data.qvel[:] = 0.3
    world = World(mj_model, num_envs=1)
    world.qvel_EL.fill_(0.3)
    asleep = []
    for _ in range(20):
        mujoco.mj_step(mj_model, mj_data, 5)
        world.step(5)
        expected = [float(speed) == 0.0 for speed in mj_data.qvel]
        assert (world.qvel_EL[0] == 0.0).tolist() == expected
        asleep.append(expected)
    # What an actuator drives never sleeps, and the other tree does by the tolerance.
    assert not any(driven for _, driven in asleep)
    assert any(alone for alone, _ in asleep) == (tolerance != "1e-9")


@pytest.mark.parametrize("kernels", KERNELS)
def test_nothing_sleeps_without_islands(kernels: str):
    """MuJoCo Warp's solver took its way for sleeping trees all the same, through arrays that it had not made."""
    xml = """
<mujoco>
  <option timestep="0.004" sleep_tolerance="0.2"><flag sleep="enable" island="disable"/></option>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    <body pos="0 0 0.099"><freejoint/><geom size="0.1" mass="1"/></body>
    <body pos="1 0 0.5"><joint axis="0 1 0" damping="0.03"/><geom type="capsule" size="0.03 0.1" mass="0.2"/></body>
  </worldbody>
</mujoco>
"""
    step_and_check(
        xml, KERNELS[kernels], substeps=12, names=("qpos", "qvel", "qacc", "qfrc_constraint")
    )
    world = World(mujoco.MjModel.from_xml_string(xml), num_envs=1, sim=KERNELS["ours"])
    assert isinstance(world, WarpWorld) and world.has_one_kernel_solver
