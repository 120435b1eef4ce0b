"""A model that has constraint rows of all kinds, states with contacts, and the C engine's view of them."""

import functools

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from ksim_rl.physics import SimCfg, World, prepare_spec

NUM_ENVS = 4
# All numbers of contact dimensions, several geoms on a body, a gap, a distance that is measured, which takes a place in
# the pool, limits of slides, hinges and balls, dry friction, and joints that are tied.
XML = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" impratio="3"/>
  <compiler angle="radian"/>
  <default><geom condim="1" friction="0.8 0.02 0.01" solref="0.006 0.9"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <geom name="wall" type="box" size="0.1 1 1" pos="-0.42 0 0" condim="3" solimp="0.8 0.9 0.01 0.3 3"/>
    <body name="trunk" pos="0 0 0.1">
      <freejoint/>
      <geom name="box" type="box" size="0.2 0.1 0.1" mass="2" condim="4"/>
      <geom name="knob" size="0.06" pos="0.2 0 -0.05" mass="0.2" condim="6" margin="0.03" gap="0.02"/>
      <body name="arm" pos="0.3 0 0">
        <joint name="shoulder" type="ball" range="0 0.4" limited="true" frictionloss="0.02" margin="0.1"/>
        <geom name="capsule" type="capsule" size="0.04" fromto="0.1 0 -0.05 0.3 0 -0.06" mass="0.4" condim="3"/>
        <body name="hand" pos="0.35 0 -0.06">
          <joint name="wrist" axis="0 1 0" range="-0.2 0.3" limited="true" frictionloss="0.1" armature="0.01"/>
          <geom name="ball" size="0.04" mass="0.2" solref="-500 -5" gap="0.4"/>
        </body>
      </body>
      <body name="drawer" pos="-0.1 0 0.1">
        <joint name="rail" type="slide" axis="1 0 0" range="-0.05 0.05" limited="true" armature="0.1"/>
        <geom type="box" size="0.05 0.05 0.05" mass="0.3" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="post" pos="0 0.02 0.25">
      <joint name="pole" axis="0 0 1" pos="0 0 0" frictionloss="0.05"/>
      <joint name="lift" type="slide" axis="0 0 1"/>
      <geom name="lid" size="0.12" mass="0.5" condim="3"/>
    </body>
  </worldbody>
  <equality>
    <joint joint1="rail" joint2="lift" polycoef="0.01 0.5 0.3 0.7 -2"/>
    <joint joint1="pole" polycoef="0.1 0 0 0 0" solref="0.03 1"/>
    <joint joint1="wrist" joint2="pole" active="false"/>
  </equality>
  <contact>
    <pair geom1="lid" geom2="box" condim="3" solreffriction="0.03 1.2" friction="0.8 0.6 0.02 0.01 0.02"/>
  </contact>
  <sensor><distance geom1="wall" geom2="lid" cutoff="2"/></sensor>
</mujoco>
"""
PER_WORLD = ("dof_frictionloss", "jnt_range", "geom_friction")


@functools.cache
def mj_model(cone: str) -> mujoco.MjModel:
    """Return the model with friction cones of one kind."""
    spec = mujoco.MjSpec.from_string(XML)
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    prepare_spec(spec, PER_WORLD)
    return spec.compile()


def touching(
    cone: str, *, njmax: int = 120, nconmax: int = 40, device: str = "cpu", num_envs: int = NUM_ENVS
) -> World:
    """Return worlds in different states, after the stages that precede the rows; the last one hangs in the air."""
    sim = SimCfg(njmax=njmax, nconmax=nconmax, one_kernel_dynamics=True)
    world = World(
        mj_model(cone), num_envs=num_envs, sim=sim, device=device, per_world_fields=PER_WORLD
    )
    generator = torch.Generator().manual_seed(0)
    world.qpos_EL[:, 2] -= 0.02
    for row, scale in ((world.qpos_EL, 0.03), (world.qpos_EL[:, 7:], 0.3), (world.qvel_EL, 0.5)):
        row.add_((scale * torch.randn(row.shape, generator=generator)).to(device))
    world.qpos_EL[-1] = torch.from_numpy(mj_model(cone).qpos0)
    world.qpos_EL[-1, 2] += 3.0
    for name in PER_WORLD[:2]:
        field = world.field(name)
        field.mul_((1.0 + 0.2 * torch.rand(field.shape, generator=generator)).to(device))
    with wp.ScopedDevice(device):
        mjw.fwd_position(world.warp_model, world.warp_data_E, factorize=False)
        mjw.fwd_velocity(world.warp_model, world.warp_data_E)
    return world


def in_c(world: World, cone: str, row: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a world's state and model in the C engine, with its constraint rows."""
    model = mujoco.MjSpec.from_string(XML)
    model.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone.upper()}")
    model.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    compiled = model.compile()
    for name in PER_WORLD:
        getattr(compiled, name)[:] = (
            world.field(name)[row].cpu().numpy().reshape(getattr(compiled, name).shape)
        )
    mj_data = mujoco.MjData(compiled)
    mj_data.qpos[:], mj_data.qvel[:] = (
        world.qpos_EL[row].cpu().numpy(),
        world.qvel_EL[row].cpu().numpy(),
    )
    mujoco.mj_forward(compiled, mj_data)
    return compiled, mj_data


def permute_pool(world: World, seed: int) -> None:
    """Put the contacts into other places of the pool, as threads may that find them side by side."""
    d = world.warp_data_E
    count = int(d.nacon.numpy()[0])
    order = np.random.default_rng(seed).permutation(count)
    for array in vars(d.contact).values():
        if isinstance(array, wp.array) and array.shape[0] == d.naconmax:
            values = array.numpy().copy()
            values[:count] = values[order]
            array.assign(values)
