"""Sensors of distances read what the C engine reads, or the model is refused by name."""

import mujoco
import numpy as np
import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

NUM_ENVS = 24
# Boxes that sensors measure one by one and by their bodies, which have other geoms, too; and a box that never moves.
MEASURED = """
<mujoco>
  <option gravity="0 0 0">{flag}</option>
  <worldbody>
    <geom name="table" type="box" size="0.3 0.2 0.05" euler="10 20 30"/>
    <body name="one" pos="0 0 0.3"><freejoint/>
      <geom name="one" type="box" size="0.1 0.05 0.07"/><geom size="0.04" pos="0.15 0 0"/>
    </body>
    <body name="other" pos="0.12 0.05 0.3"><freejoint/>
      <geom name="other" type="box" size="0.04 0.12 0.06"/>
      <geom type="box" size="0.05 0.02 0.03" pos="-0.1 0.1 0" euler="0 0 40"/>
      <geom type="capsule" size="0.03 0.1" pos="-0.1 0.1 0.1"/>
    </body>
  </worldbody>
  <sensor>
    <distance geom1="one" geom2="other" cutoff="2"/>
    <normal geom1="one" geom2="other" cutoff="2"/>
    <fromto geom1="other" geom2="one" cutoff="2"/>
    <distance geom1="other" geom2="one" cutoff="0.1"/>
    <normal geom1="other" geom2="one"/>
    <distance body1="one" body2="other" cutoff="2"/>
    <normal body1="other" body2="one" cutoff="2"/>
    <fromto geom1="table" body2="other" cutoff="2"/>
  </sensor>
</mujoco>
"""
TORUS = """
<mujoco>
  <extension><plugin plugin="mujoco.sdf.torus"><instance name="torus"/></plugin></extension>
  <asset><mesh name="torus"><plugin instance="torus"/></mesh></asset>
  <worldbody>
    <body><freejoint/><geom name="ring" type="sdf" mesh="torus"><plugin instance="torus"/></geom></body>
  </worldbody>
</mujoco>
"""
FIELD = """
<mujoco>
  <asset><mesh name="wedge" vertex="-.1 -.1 -.1 .1 -.1 -.1 0 .1 -.1 0 0 .1"/></asset>
  <worldbody>
    <body name="hand"><freejoint/><geom name="wedge" type="sdf" mesh="wedge"/></body>
    <body name="ball" pos="0 0 1"><freejoint/><geom name="ball" size="0.1"/></body>
  </worldbody>
  <sensor>{sensor}</sensor>
</mujoco>
"""


def poses(mj_model: mujoco.MjModel) -> torch.Tensor:
    """Draw poses of the two bodies, some apart and some in each other, [E, 14]."""
    rng = np.random.default_rng(0)
    qpos = np.tile(mj_model.qpos0, (NUM_ENVS, 1))
    for first in (0, 7):
        qpos[:, first : first + 3] += rng.uniform(-0.1, 0.1, (NUM_ENVS, 3))
        quat = rng.normal(size=(NUM_ENVS, 4))
        qpos[:, first + 3 : first + 7] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    # Boxes with parallel faces, apart and in each other.
    qpos[:2, [3, 10]] = 1.0
    qpos[:2, [4, 5, 6, 11, 12, 13]] = 0.0
    qpos[0, 7:10] = qpos[0, :3] + [0.3, 0.02, 0.01]
    qpos[1, 7:10] = qpos[1, :3] + [0.13, 0.02, 0.01]
    return torch.tensor(qpos, dtype=torch.float32)


def in_c(mj_model: mujoco.MjModel, pose_EL: torch.Tensor) -> np.ndarray:
    read, mj_data = [], mujoco.MjData(mj_model)
    for qpos in pose_EL.double().numpy():
        mj_data.qpos[:] = qpos
        mujoco.mj_forward(mj_model, mj_data)
        read.append(mj_data.sensordata.copy())
    return np.array(read)


@pytest.mark.parametrize("one_kernel", [True, False])
@pytest.mark.parametrize("flag", ["", '<flag contact="disable"/>'])
def test_boxes_are_as_far_apart_and_as_deep_as_in_the_c_engine(one_kernel: bool, flag: str):
    mj_model = load_model(MEASURED.format(flag=flag))
    sim = SimCfg(njmax=120, nconmax=60, one_kernel_dynamics=one_kernel)
    world = World(mj_model, num_envs=NUM_ENVS, sim=sim)
    pose_EL = poses(mj_model)
    world.qpos_EL.copy_(pose_EL)
    world.step()
    read, expected = world.sensordata_EL.numpy(), in_c(mj_model, pose_EL)
    distance = expected[:, 0]
    assert (distance > 0.05).sum() > 3 and (distance < -0.01).sum() > 3
    places = np.zeros(read.shape, dtype=bool)
    for sensor in np.flatnonzero(mj_model.sensor_type == mujoco.mjtSensor.mjSENS_GEOMFROMTO):
        places[:, mj_model.sensor_adr[sensor] : mj_model.sensor_adr[sensor] + 6] = True
    # Where faces are parallel, any place of theirs is as close.
    places[2:] = False
    np.testing.assert_allclose(read[~places], expected[~places], atol=2e-5)
    between = read[:2, 4:7] - read[:2, 7:10]
    np.testing.assert_allclose(between, expected[:2, 4:7] - expected[:2, 7:10], atol=2e-5)


def test_distances_where_no_constraints_are_made_are_refused():
    with pytest.raises(ValueError, match=r"sensor number 0 \(unnamed\) needs a collision pass"):
        load_model(MEASURED.format(flag='<flag constraint="disable"/>'))


@pytest.mark.parametrize(
    ("sensor", "name"),
    [
        (
            '<distance name="gap" geom1="wedge" geom2="ball" cutoff="1"/>',
            "'gap' reads distances of geom 'wedge'",
        ),
        (
            '<fromto name="gap" body1="ball" body2="hand" cutoff="1"/>',
            "'gap' reads distances of geom 'wedge'",
        ),
        ('<contact name="touch" subtree1="hand"/>', "'touch' reads contacts of geom 'wedge'"),
        ('<contact name="touch" geom1="ball"/>', "'touch' reads contacts of geom 'wedge'"),
    ],
)
def test_sensors_of_signed_distance_fields_are_refused(sensor: str, name: str):
    with pytest.raises(ValueError, match=f"sensor {name}, a signed distance field"):
        load_model(FIELD.format(sensor=sensor))


def test_signed_distance_fields_of_plugins_are_refused():
    with pytest.raises(ValueError, match="geom 'ring' collides, and its plugin computes it"):
        load_model(TORUS)
