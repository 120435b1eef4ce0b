"""Compares the physics of an env with MuJoCo's C engine, from states that random actions reach."""

import copy

import mujoco
import numpy as np
from torchrl.envs import EnvBase

from ksim_rl.envs.contract import SimulatedWorld, part
from ksim_rl.physics import World
from ksim_rl.physics.fields import write_fields
from ksim_rl.testing.replays import Replays

SUBSTEPS = 20
# As a share of the scale of a velocity, after these substeps: float32 and a solver that stops early stay far below; a
# field or an option that one engine does not know of goes far beyond.
MEDIAN_TOLERANCE = 1e-3
TOLERANCE = 1e-2
# Relative shift of states, which shows how much rounding and contacts that just begin change in the C engine itself,
# and the factor by which a row may differ more than that.
MOVED = 1e-5
ALLOWANCE = 10.0
# Iterations after which the C engine has solved a step: with a model's own number it, too, may stop early.
SOLVED = 100
# m: without a margin C has contacts of boxes and meshes with height fields less deep than they are (docs/upstream.md).
LEAST_MARGIN = 1e-7
_INPUTS = "qpos qvel act ctrl qfrc_applied xfrc_applied mocap_pos mocap_quat qacc_warmstart eq_active time"


def check_c_engine(env: EnvBase, num_steps: int) -> None:
    """20 substeps from states that random actions reach agree with MuJoCo's C engine, in the worst row too.

    A row may also agree with a C engine that solves each step to the end instead, and may differ by more where the C
    engine itself does, from states moved by 1e-5.
    """
    simulated = part(env, SimulatedWorld)
    if simulated is None:
        return
    replays = Replays(env, num_steps)
    root = replays.start()
    # Random actions lead to states with contacts and moving joints.
    for index in range(num_steps):
        _, root = replays.step(root, index)
    world = simulated.world
    mj_model = world.mj_model
    # The C engine first: stepping the worlds changes the state that it starts from.
    expected_EL, *moved = (_c_engine(world, moved=by) for by in (0.0, MOVED, -MOVED))
    solved_EL = _c_engine(world, iterations=SOLVED)
    world.step(SUBSTEPS)
    actual_EL = world.qvel_EL.cpu().numpy().astype(np.float64)
    # The env's clocks and observations do not know of these substeps.
    env.reset()
    scale_E1 = 1.0 + np.abs(expected_EL).max(axis=-1, keepdims=True)
    # [2, E, nv]: against the C engine as configured, and against one that solves to the end.
    errors_EL = np.stack(
        [np.abs(actual_EL - each_EL) / scale_E1 for each_EL in (expected_EL, solved_EL)]
    )
    # For each row the engine that agrees better, by its worst joint.
    error_EL = errors_EL[errors_EL.max(axis=-1).argmin(axis=0), np.arange(len(actual_EL))]
    # How chaotic each row is: the change by states that were moved a little.
    spread_E = np.max(
        [np.abs(other_EL - expected_EL) / scale_E1 for other_EL in moved], axis=(0, -1)
    )
    error_E = error_EL.max(axis=-1)
    chaos_E = ALLOWANCE * spread_E
    allowed_E = TOLERANCE + chaos_E
    worst = int(np.argmax(error_E - allowed_E))
    # Of two rows the median is the mean, so that one chaotic row is half of it.
    median_differs = np.median(error_E - chaos_E) > MEDIAN_TOLERANCE
    if median_differs or (error_E > allowed_E).any():
        joint = mj_model.joint(int(mj_model.dof_jntid[np.argmax(error_EL[worst])])).name
        raise AssertionError(
            f"after {SUBSTEPS} substeps qvel differs from the C engine's by {np.median(error_E):.2g} of its scale "
            f"in the median row (allowed {MEDIAN_TOLERANCE}), and by {error_E[worst]:.2g} in row {worst} at joint "
            f"{joint!r} (allowed {allowed_E[worst]:.2g}). Look for a model feature that Warp treats otherwise, for too "
            "few solver iterations (`sim.iterations`), and for contacts that did not fit (`world.overflow_report()`)"
        )


def _c_engine(world: World, *, moved: float = 0.0, iterations: int = 0) -> np.ndarray:
    """Return qvel [E, nv] after substeps of the C engine from the rows' states, moved by a share of themselves.

    Its solver makes at most as many `iterations` as the model says, or as are asked for where these are more.
    """
    # Read once for all rows, as each read waits for the device.
    inputs = {name: world.view(name).cpu().numpy() for name in _INPUTS.split()}
    fields = {name: values_E.cpu().numpy() for name, values_E in world.per_world_fields().items()}
    reached = []
    for row in range(world.num_envs):
        # A model for each row, with the fields that differ between worlds.
        mj_model = copy.copy(world.mj_model)
        write_fields(mj_model, {name: values[row] for name, values in fields.items()})
        is_field = mj_model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
        mj_model.geom_margin[is_field] = np.maximum(mj_model.geom_margin[is_field], LEAST_MARGIN)
        mj_model.opt.iterations = max(mj_model.opt.iterations, iterations)
        mj_data = mujoco.MjData(mj_model)
        for name, values in inputs.items():
            if name == "time":
                mj_data.time = float(values[row])
            elif values[row].size:
                # MuJoCo's arrays are views of its memory, so they are filled and not replaced.
                target = getattr(mj_data, name)
                target[:] = values[row].reshape(target.shape)
        mj_data.qpos *= 1.0 + moved
        mj_data.qvel *= 1.0 + moved
        mujoco.mj_step(mj_model, mj_data, SUBSTEPS)
        reached.append(np.array(mj_data.qvel))
    return np.stack(reached)
