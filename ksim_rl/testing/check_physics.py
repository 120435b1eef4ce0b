"""This module compares one physics substep of an env with MuJoCo's C engine."""

import copy

import mujoco
import numpy as np
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import SimulatedWorld, part
from ksim_rl.physics import World
from ksim_rl.testing.replays import Replays

# Of the scale of a velocity, per substep: float32 and a solver that stops early stay far below; a field or an option
# that one engine does not know of goes far beyond.
TOLERANCE = 1e-2
# The C engine finds several contacts of a geom with neighbouring triangles of a height field where we find the one that
# a plane would have: the same place, but stiffer.
HEIGHT_FIELD_TOLERANCE = 1e-1
_INPUTS = ("qpos", "qvel", "act", "ctrl", "qfrc_applied", "xfrc_applied", "mocap_pos", "mocap_quat", "time")


def check_c_engine(env: EnvBase, num_steps: int) -> None:
    """One physics substep from the states that random actions lead to agrees with MuJoCo's C engine, in most rows."""
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return
    replays = Replays(env, num_steps)
    root = replays.start()
    for index in range(num_steps):
        _, root = replays.step(root, index)
    world = simulated.world
    expected_EL = np.stack([_c_step(world, row) for row in range(world.num_envs)])
    world.step(1)
    actual_EL = world.qvel_EL.cpu().numpy().astype(np.float64)
    env.reset()
    scale = 1.0 + np.abs(expected_EL).max(axis=-1)
    error_E = np.abs(actual_EL - expected_EL).max(axis=-1) / scale
    on_height_field = np.isin(mujoco.mjtGeom.mjGEOM_HFIELD, world.mj_model.geom_type)
    tolerance = HEIGHT_FIELD_TOLERANCE if on_height_field else TOLERANCE
    if np.median(error_E) > tolerance:
        raise AssertionError(
            f"after one substep qvel differs from the C engine's by {np.median(error_E):.2g} of its scale in the "
            f"median row (allowed {tolerance}). Look for a model feature that Warp treats otherwise, for too few "
            "solver iterations (`sim.iterations`), and for contacts that did not fit (`world.overflow_report()`)"
        )


def _c_step(world: World, row: int) -> np.ndarray:
    """Return qvel after one step of the C engine from the state, and with the model, of a row."""
    mj_model = copy.copy(world.mj_model)
    for name, values_E in world.per_world_fields().items():
        values = values_E[row].cpu().numpy()
        if name == "gravity":
            mj_model.opt.gravity[:] = values
        else:
            getattr(mj_model, name)[:] = values.reshape(getattr(mj_model, name).shape)
    data = mujoco.MjData(mj_model)
    for name in _INPUTS:
        target = np.asarray(getattr(data, name))
        if target.size:
            values = world.view(name)[row].cpu().numpy()
            if name == "time":
                data.time = float(values)
            else:
                target[:] = values.reshape(target.shape)
    mujoco.mj_step(mj_model, data)
    return np.array(data.qvel)
