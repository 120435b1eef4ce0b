"""Actuators that adhere to a body, beside the C engine, and what a refresh and a reset leave of them."""

from typing import Any

import mujoco
import pytest
import torch

from tests.physics.beside_c import (
    ALL_KERNELS,
    KERNELS,
    THEIRS,
    check_sensors,
    started,
    step_and_check,
)

STUCK = """
<mujoco>
  <option timestep="0.004" integrator="{integrator}"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <geom name="post" pos="2.5 0 0.3" size="0.1"/>
    <body name="ball" pos="2 0 0.0995"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="1"/></body>
    <body name="box" pos="1 0 0.0995"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>
    {more}
  </worldbody>
  <actuator>
    <adhesion name="ball" body="ball" ctrlrange="0 10" gain="3"/>
    <adhesion name="box" body="box" ctrlrange="0 10" gain="3"/>
  </actuator>
  <sensor>
    <actuatorvel actuator="ball"/><actuatorvel actuator="box"/><actuatorfrc actuator="ball"/>
    <distance geom1="ball" geom2="post" cutoff="2"/>
  </sensor>
</mujoco>
"""
# So slow that what is in contact stays in contact.
CALM: dict[str, Any] = {"spread": 0.0003, "speed": 0.02}


@pytest.mark.parametrize("kernels", ("our solver", THEIRS))
@pytest.mark.parametrize("integrator", ("implicitfast", "RK4"))
def test_pairs_that_a_sensor_measures_are_no_contacts(integrator: str, kernels: str) -> None:
    step_and_check(STUCK.format(integrator=integrator, more=""), KERNELS[kernels], **CALM)


# All corners of a flat box are within the margin, and those above its centre make no contacts.
FLAT = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" margin="0.05" adhesion="3"/>
    <body name="box" pos="1 0 0.01"><joint axis="1 1 0" pos="0.3 0 0"/>
      <geom type="box" size="0.1 0.1 0.01" mass="1" adhesion="{adhesion}"/></body>
  </worldbody>
  <actuator><adhesion body="box" ctrlrange="0 10" gain="3"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize("kernels", ("our solver", THEIRS))
@pytest.mark.parametrize("integrator", ("implicitfast", "RK4"))
def test_upper_corners_of_boxes_do_not_stick(integrator: str, kernels: str) -> None:
    names = ("qpos", "qvel", "qacc", "qfrc_passive", "actuator_velocity")
    for adhesion in (0.0, 1.0):
        xml = FLAT.format(adhesion=adhesion).replace(
            "<option", f'<option integrator="{integrator}"'
        )
        step_and_check(xml, KERNELS[kernels], names=names, **CALM)


@pytest.mark.parametrize("kernels", ALL_KERNELS)
def test_a_pair_of_one_rigid_body_does_not_stick(kernels: str) -> None:
    xml = """
<mujoco>
  <worldbody>
    <body><joint axis="0 1 0" pos="0.3 0 0"/><geom name="a" size="0.1"/>
      <body><geom name="b" size="0.1" pos="0.1 0 0.1"/></body></body>
    <geom name="post" size="0.1" pos="0 0.1 0.19"/><geom name="floor" type="plane" pos="0 0 -0.09" size="1 1 1"/>
  </worldbody>
  <contact><pair geom1="a" geom2="b" adhesion="4"/><pair geom1="post" geom2="floor" adhesion="4"/></contact>
  <sensor><contact geom1="a" geom2="b" data="found force"/><contact body1="world" data="found force" num="3"/></sensor>
</mujoco>
"""
    step_and_check(xml, KERNELS[kernels], names=("qpos", "qvel", "qacc", "qfrc_passive"), **CALM)


@pytest.mark.parametrize("kernels", ALL_KERNELS)
@pytest.mark.parametrize("other", ("beside", "welded"))
def test_an_actuator_does_not_adhere_by_a_pair_of_one_rigid_body(other: str, kernels: str) -> None:
    xml = f"""
<mujoco>
  <worldbody>
    <geom type="plane" size="3 3 0.1"/>
    <body name="foot" pos="0 0 0.04"><freejoint/>
      <geom name="sole" size="0.045" mass="1"/><geom name="beside" size="0.045" pos="0.02 0 0" mass="1"/>
      <body><geom name="welded" size="0.05" pos="0.03 0 0.05" mass="1"/></body></body>
  </worldbody>
  <contact><pair geom1="sole" geom2="{other}"/></contact>
  <actuator><adhesion body="foot" ctrlrange="0 1" gain="4"/></actuator>
</mujoco>
"""
    names = ("qpos", "qvel", "qfrc_actuator", "actuator_velocity")
    step_and_check(xml, KERNELS[kernels], names=names, substeps=1, **CALM)


@pytest.mark.parametrize("more", ("", '<body mocap="true"/>'), ids=("own reset", "their reset"))
def test_a_reset_of_one_world_leaves_the_adhesion_of_another(more: str) -> None:
    world, mj_data, in_c = started(
        STUCK.format(integrator="Euler", more=more), KERNELS["ours"], **CALM
    )
    world.step(1)
    mujoco.mj_step(in_c, mj_data)
    world.reset(torch.tensor([True, False]))
    world.refresh()
    assert (world.sensordata_EL[0, :2] == 0.0).all()
    mujoco.mj_forward(in_c, mj_data)
    check_sensors(world, mj_data, of_forces=False)


@pytest.mark.parametrize("kernels", ("our solver", THEIRS))
def test_geoms_do_not_stick_where_a_sensor_alone_reaches_them(kernels: str) -> None:
    xml = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <geom name="post" size="0.1" adhesion="4"/>
    <body pos="0.5 0 0"><joint axis="0 1 0" pos="0.2 0 0.1"/><geom name="ball" size="0.1" mass="1"/></body>
  </worldbody>
  <sensor><distance geom1="ball" geom2="post" cutoff="2"/></sensor>
</mujoco>
"""
    step_and_check(xml, KERNELS[kernels], names=("qpos", "qvel", "qacc", "qfrc_passive"))
