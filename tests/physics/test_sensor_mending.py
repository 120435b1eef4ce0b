"""Contact sensors of every kind, and touch sensors with bounds, read what the C engine reads."""

import itertools

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

# A box whose weight is off its middle slides on a floor, and leans on a wall; a ball lies between both.
THINGS = """
<mujoco>
  <option timestep="0.002" cone="{cone}"/>
  <default><geom friction="0.6 0.02 0.01" condim="4"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <geom name="wall" type="box" size="0.1 1 1" pos="-0.299 0 0"/>
    <body name="trunk" pos="0 0 0.098">
      <freejoint/>
      <geom name="box" type="box" size="0.2 0.15 0.1" mass="1"/>
      <geom name="weight" size="0.02" pos="0.12 0.05 0" mass="2" contype="0" conaffinity="0"/>
      <site name="all" type="ellipsoid" size="0.5 0.5 0.5"/><site name="corner" pos="0.2 0.15 -0.1" size="0.03"/>
      <site name="edge" type="capsule" size="0.03 0.2" pos="0.2 0 -0.1" euler="90 0 0"/>
      <site name="half" type="box" size="0.2 0.3 0.3" pos="0.2 0 0"/>
      <site name="disk" type="cylinder" size="0.23 0.02" pos="0 0 -0.1"/>
      <body pos="0 0.21 -0.05">
        <joint type="ball" damping="0.1"/><geom name="ball" size="0.051" pos="0 0.02 0" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <sensor>
    <touch site="all"/><touch site="all" cutoff="7.5"/>
    <touch site="corner" cutoff="1e-3"/><touch site="half" cutoff="99"/>
  </sensor>
</mujoco>
"""
EVERYTHING, NO_VELOCITIES = 0b111111111, 0b001111111
OBJECT = mujoco.mjtObj
OWN = [
    (OBJECT.mjOBJ_GEOM, "box"),
    (OBJECT.mjOBJ_XBODY, "trunk"),
    (OBJECT.mjOBJ_BODY, "world"),
    None,
]
OWN += [(OBJECT.mjOBJ_SITE, name) for name in ("all", "corner", "edge", "half", "disk")]
OTHER = [None, (OBJECT.mjOBJ_GEOM, "floor")]
REDUCTIONS = {"none": 0, "mindist": 1, "maxforce": 2, "netforce": 3}
FOUND_AND_DISTANCE, FORCE_AND_POSITION = 0b1001, 0b10010
FIELDS = (EVERYTHING, FOUND_AND_DISTANCE, FORCE_AND_POSITION)


def model(cone: str) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(THINGS.format(cone=cone))
    ways = itertools.product(OWN, OTHER, REDUCTIONS.values(), FIELDS)
    for own, other, reduction, fields in ways:
        slots = 3
        if reduction == REDUCTIONS["netforce"]:
            slots, fields = 1, fields & NO_VELOCITIES
        sensor = spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT, intprm=[fields, reduction, slots]
        )
        if own is not None:
            sensor.objtype, sensor.objname = own
        if other is not None:
            sensor.reftype, sensor.refname = other
    return load_model(spec)


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("one_kernel", [True, False])
def test_all_sensors_of_contacts_read_what_they_read_in_c(cone: str, one_kernel: bool):
    mj_model = model(cone)
    sim = SimCfg(
        njmax=120, nconmax=20, one_kernel_dynamics=one_kernel, iterations=100, ls_iterations=50
    )
    world = World(mj_model, num_envs=2, sim=sim)
    rng = np.random.default_rng(0)
    qvel_EL = 0.3 * rng.standard_normal(world.qvel_EL.shape)
    qpos_EL = np.tile(mj_model.qpos0, (2, 1))
    qpos_EL[:, 3:7] += 0.003 * rng.standard_normal((2, 4))
    qpos_EL[:, 3:7] /= np.linalg.norm(qpos_EL[:, 3:7], axis=1, keepdims=True)
    world.qpos_EL.copy_(torch.tensor(qpos_EL))
    world.qvel_EL.copy_(torch.tensor(qvel_EL))
    world.step()
    expected = np.empty(0)
    for row in range(2):
        mj_data = mujoco.MjData(mj_model)
        mj_data.qpos[:], mj_data.qvel[:] = (
            qpos_EL[row].astype(np.float32),
            qvel_EL[row].astype(np.float32),
        )
        mujoco.mj_forward(mj_model, mj_data)
        assert mj_data.ncon > 5
        read, expected = world.sensordata_EL[row].numpy(), mj_data.sensordata
        scale = np.maximum(1.0, np.abs(expected))
        for sensor in range(mj_model.nsensor):
            at = slice(
                mj_model.sensor_adr[sensor],
                mj_model.sensor_adr[sensor] + mj_model.sensor_dim[sensor],
            )
            setting = mj_model.sensor_intprm[sensor]
            # Forces come from two solvers.
            tolerance = 1e-5 if setting[0] == FOUND_AND_DISTANCE else 2e-2
            message = f"sensor {sensor}, {setting}: {read[at]}, in C {expected[at]}"
            assert (np.abs(read[at] - expected[at]) <= tolerance * scale[at]).all(), message
    assert expected[1] == 7.5 and expected[2] == pytest.approx(1e-3) and 0.0 < expected[3] < 99.0


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (
            '<contact name="s" geom1="ball" data="found" nsample="2"/>',
            "'s' reads the first contacts",
        ),
        (
            '<touch name="s" site="all" cutoff="1" nsample="2" interp="linear"/>',
            "'s' has a cutoff of 1",
        ),
    ],
)
def test_delays_that_mujoco_warp_has_before_our_reading_are_refused(sensor: str, message: str):
    xml = THINGS.format(cone="pyramidal").replace("</sensor>", f"{sensor}</sensor>")
    with pytest.raises(ValueError, match=f"sensor {message}"):
        load_model(xml)


MESH_SITES = """
<mujoco>
  <asset><mesh name="stone" vertex="0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="b" pos="0 0 0.009"><freejoint/><geom size="0.01"/><site name="t" type="mesh" mesh="stone"/></body>
  </worldbody>
  <sensor>{}</sensor>
</mujoco>
"""


@pytest.mark.parametrize(
    "sensor",
    [
        '<insidesite site="t" objtype="body" objname="b"/>',
        '<contact site="t" data="found"/>',
        '<touch site="t"/>',
    ],
)
def test_what_is_in_a_site_with_a_mesh_is_refused(sensor: str):
    with pytest.raises(ValueError, match="site 't', which has the shape of a mesh"):
        World(mujoco.MjModel.from_xml_string(MESH_SITES.format(sensor)), num_envs=1)


def test_frames_of_a_site_with_a_mesh_are_read():
    world = World(
        load_model(MESH_SITES.format('<framepos objtype="site" objname="t"/>')), num_envs=1
    )
    world.refresh()
    torch.testing.assert_close(world.sensordata_EL[0], torch.tensor([0.0, 0.0, 0.009]))
