"""Where trees may sleep, what is read of a substep is the substep's, as in C."""

from typing import Literal

import mujoco
import pytest

from ksim_rl.physics import SimCfg, World
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
