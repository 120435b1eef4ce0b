"""Worlds with constraint rows of every kind."""

import pytest
import torch

from ksim_rl.physics import SimCfg, World, load_model

NUM_ENVS = 6
ROWS_OF_ALL_KINDS = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" iterations="{iterations}" tolerance="1e-8" cone="{cone}"
          impratio="3"/>
  <worldbody>
    <geom type="plane" size="5 5 1" condim="1" friction="0.8 0.02 0.01"/>
    <body name="pushed" pos="0 0 0.09">
      <freejoint/>
      <geom size="0.1" pos="0.2 0 0" condim="6" mass="0.4"/>
      <geom size="0.1" pos="-0.2 0.1 0" condim="4" mass="0.3"/>
      <geom size="0.1" pos="-0.2 -0.1 0" condim="3" mass="0.3"/>
      <body pos="0 0 0.1">
        <joint name="a" axis="0 1 0" range="-0.2 0.2" limited="true" damping="0.1"/>
        <geom type="capsule" size="0.03 0.1" pos="0 0 0.15" mass="0.2" contype="0" conaffinity="0"/>
        <body pos="0 0 0.3">
          <joint name="b" axis="1 0 0" frictionloss="0.05" armature="0.01"/>
          <geom size="0.05" mass="0.1" pos="0.1 0 0" contype="0" conaffinity="0"/>
        </body>
      </body>
    </body>
    <body name="smooth" pos="1 0 0.08">
      <freejoint/>
      <geom size="0.09" condim="1" mass="0.5"/>
    </body>
    <body name="arm" pos="1 0.5 0.5">
      <joint name="c" axis="0 1 0"/>
      <geom type="capsule" size="0.02 0.2" mass="0.3" contype="0" conaffinity="0"/>
      <site name="tip" pos="0 0 0.2"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="rope" limited="true" range="-0.1 0.1" frictionloss="0.02">
      <joint joint="a" coef="1"/><joint joint="c" coef="-1"/>
    </fixed>
  </tendon>
  <equality><joint joint1="c" joint2="b" polycoef="0.1 0.5 0 0 0"/></equality>
</mujoco>
"""
CONES = ("pyramidal", "elliptic")
# Each case compiles kernels of its own.
ONE_OF_CONES = (pytest.param("pyramidal", marks=pytest.mark.full), "elliptic")


def worlds(cone: str, *, iterations: int = 100, **sim) -> World:
    model = load_model(ROWS_OF_ALL_KINDS.format(cone=cone, iterations=iterations))
    world = World(model, num_envs=NUM_ENVS, sim=SimCfg(njmax=64, nconmax=16, tolerance=1e-8, **sim))
    generator = torch.Generator().manual_seed(0)
    world.qpos_EL[:, 2] -= 0.02 * torch.rand(NUM_ENVS, generator=generator)
    world.qpos_EL[:, 7:9] += 0.4 * torch.randn(NUM_ENVS, 2, generator=generator)
    world.qvel_EL.copy_(0.7 * torch.randn(world.qvel_EL.shape, generator=generator))
    # The last world falls freely, with no row of a contact.
    world.qpos_EL[-1, 2] = 1.0
    return world
