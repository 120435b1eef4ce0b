"""Models for the tests, and the C engine's answer for them."""

import functools

import mujoco
import numpy as np
import torch

from benchmarks.agreement_models import CARTPOLE, QUADRUPED
from ksim_rl.physics import SimCfg, World, load_model

NUM_ENVS = 4
SUBSTEPS = 4


@functools.cache
def quadruped() -> mujoco.MjModel:
    return load_model(QUADRUPED)


@functools.cache
def cartpole() -> mujoco.MjModel:
    return load_model(CARTPOLE)


def standing_quadrupeds(num_envs: int = NUM_ENVS, **kwargs) -> World:
    """Quadrupeds that stand, each in another pose and with other controls, after a few steps of contact."""
    kwargs.setdefault("sim", SimCfg(njmax=80, nconmax=40))
    world = World(quadruped(), num_envs=num_envs, **kwargs)
    key = world.mj_model.keyframe("stand")
    generator = torch.Generator().manual_seed(1)
    noise = 0.1 * torch.randn(num_envs, 8, generator=generator)
    world.qpos_EL.copy_(torch.from_numpy(key.qpos).float().expand_as(world.qpos_EL))
    world.qpos_EL[:, 7:] += noise.to(world.device)
    world.ctrl_EL.copy_(torch.from_numpy(key.ctrl).float().expand_as(world.ctrl_EL))
    for _ in range(10):
        world.step(SUBSTEPS)
    world.refresh()
    return world


def sensor(world: World, name: str) -> slice:
    """The columns of one sensor in sensordata."""
    found = world.mj_model.sensor(name)
    return slice(found.adr[0], found.adr[0] + found.dim[0])


def forwarded(world: World, row: int) -> mujoco.MjData:
    """The C engine's forward pass at the present state of one world."""
    mj_data = mujoco.MjData(world.mj_model)
    mj_data.qpos[:] = world.qpos_EL[row].cpu().numpy().astype(np.float64)
    mj_data.qvel[:] = world.qvel_EL[row].cpu().numpy().astype(np.float64)
    mj_data.ctrl[:] = world.ctrl_EL[row].cpu().numpy().astype(np.float64)
    mujoco.mj_forward(world.mj_model, mj_data)
    return mj_data
