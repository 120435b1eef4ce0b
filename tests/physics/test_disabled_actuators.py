"""Actuators of groups that `actuatorgroupdisable` disables, beside the C engine."""

import mujoco
import pytest

from tests.physics.beside_c import ALL_KERNELS, KERNELS, started, step_and_check

ARM = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}" actuatorgroupdisable="1 3"/>
  <worldbody>
    <body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0" contype="0" conaffinity="0"/>
      <body pos="0.2 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0" contype="0"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="rope"><joint joint="a" coef="1"/></fixed></tendon>
  <actuator>
    <motor joint="a" group="1" gear="2"/>
    <position joint="b" group="2" kp="3" kv="1"/>
    <intvelocity joint="a" group="3" actrange="-1 1" kp="5"/>
    <general joint="b" group="1" dyntype="filter" dynprm="0.1" gainprm="4" actearly="true"/>
    <velocity joint="b" kv="4" group="3"/>
    <motor joint="b" group="1" forcerange="0.5 2"/>
    {more}
  </actuator>
  <sensor><actuatorfrc actuator="0"/></sensor>
</mujoco>
""".replace('<motor joint="a"', '<motor name="0" joint="a"')
WITHOUT_TENDON = ARM.replace(
    '<tendon><fixed name="rope"><joint joint="a" coef="1"/></fixed></tendon>', ""
)
MORE = '<muscle joint="a" group="1" lengthrange="0 1"/><motor tendon="rope" group="3"/>'
INTEGRATORS = ("Euler", "implicitfast", "implicit", "RK4")


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kernels", ALL_KERNELS)
def test_disabled_actuators_make_no_force_and_keep_their_activations(
    kernels: str, integrator: str
) -> None:
    step_and_check(WITHOUT_TENDON.format(integrator=integrator, more=""), KERNELS[kernels])


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_disabled_muscles_and_motors_of_tendons_are_off_too(integrator: str) -> None:
    step_and_check(ARM.format(integrator=integrator, more=MORE), KERNELS["our solver"])


def test_an_enabled_group_still_drives() -> None:
    enabled = WITHOUT_TENDON.format(integrator="Euler", more="").replace(
        'actuatorgroupdisable="1 3"', ""
    )
    world, _, _ = started(enabled, KERNELS["ours"])
    world.step(1)
    assert (world.actuator_force_EL[1] != 0.0).all()
    step_and_check(enabled, KERNELS["ours"])


def test_groups_without_a_bit_are_never_disabled() -> None:
    mj_model = mujoco.MjModel.from_xml_string(WITHOUT_TENDON.format(integrator="Euler", more=""))
    mj_model.actuator_group[:] = 32 + 1
    step_and_check(mj_model, KERNELS["ours"])


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_without_actuation_activations_keep_still_even_out_of_their_range(integrator: str) -> None:
    flag = '<option><flag actuation="disable"/></option>'
    xml = WITHOUT_TENDON.format(integrator=integrator, more="").replace(
        "<worldbody>", flag + "<worldbody>"
    )
    step_and_check(xml.replace('actrange="-1 1"', 'actrange="-1 -0.9"'), KERNELS["our solver"])
