"""Armature and damping that only some worlds' actuators add to joints and tendons, beside the C engine."""

import mujoco
import numpy as np
import pytest

from tests.physics.beside_c import KERNELS, THEIRS, check, started

CHAIN = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint name="h" axis="0 1 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 -0.3" mass="0.3"/>
      <body pos="0 0 -0.3"><joint name="k" axis="0 1 0"/><geom size="0.05" mass="0.2" pos="0.1 0 0"/></body>
    </body>
  </worldbody>
  {tendon}
  <actuator><motor joint="h" gear="3"/><motor joint="k"/><motor joint="k" gear="2"/>{more}</actuator>
</mujoco>
"""
TENDON = '<tendon><fixed name="t"><joint joint="h" coef="1"/><joint joint="k" coef="-0.5"/></fixed></tendon>'
CONSTANTS = ("dof_invweight0", "body_invweight0", "actuator_acc0")


@pytest.mark.parametrize("has_tendon", (False, True), ids=("joints", "and a tendon"))
@pytest.mark.parametrize("integrator", ("Euler", "implicitfast"))
@pytest.mark.parametrize("kernels", ("ours", THEIRS))
def test_each_world_has_what_its_actuators_add(
    kernels: str, integrator: str, has_tendon: bool
) -> None:
    tendon = TENDON if has_tendon else ""
    more = '<motor tendon="t" gear="2"/>' if has_tendon else ""
    mj_model = mujoco.MjModel.from_xml_string(
        CHAIN.format(integrator=integrator, tendon=tendon, more=more)
    )
    numbers = np.arange(1.0, mj_model.nu + 1.0)
    fields = {"actuator_armature": 0.02 * numbers, "actuator_damping": 0.05 * numbers}
    world, mj_data, in_c = started(mj_model, KERNELS[kernels], fields=fields)
    world.step(5)
    for _ in range(5):
        mujoco.mj_step(in_c, mj_data)
    check(world, mj_data)
    for name in CONSTANTS:
        found = world.field(name)[1].numpy()
        np.testing.assert_allclose(
            found, getattr(in_c, name).reshape(found.shape), rtol=1e-4, err_msg=name
        )


def test_the_other_world_adds_nothing() -> None:
    mj_model = mujoco.MjModel.from_xml_string(CHAIN.format(integrator="Euler", tendon="", more=""))
    world, mj_data, _ = started(
        mj_model,
        KERNELS["ours"],
        fields={"actuator_damping": np.ones(3), "actuator_armature": np.ones(3)},
    )
    plain = mujoco.MjData(mj_model)
    plain.qpos[:], plain.qvel[:], plain.ctrl[:] = mj_data.qpos, mj_data.qvel, mj_data.ctrl
    world.step(5)
    for _ in range(5):
        mujoco.mj_step(world.mj_model, plain)
    np.testing.assert_allclose(world.qvel_EL[0].numpy(), plain.qvel, atol=1e-4)
