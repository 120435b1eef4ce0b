"""The worlds of a model: fields and states of their own, for both engines."""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
import torch

from benchmarks.judge.compiled import compiled_with
from ksim_rl.physics import SimCfg, World, poses
from ksim_rl.physics.constants.least_weights import least_weights
from ksim_rl.physics.fields import GRAVITY, write_fields
from ksim_rl.physics.load import caught_warnings

Arrays = dict[str, np.ndarray]
# What a step depends on, but for what a reset makes: past values of delays, and which trees sleep.
STATE = (
    "time",
    "qpos",
    "qvel",
    "act",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "mocap_pos",
    "mocap_quat",
    "eq_active",
    "plastic",
)
# By how much numbers are rounded on the way into float32.
ROUNDING = 1.2e-7
# Constraints whose rows are of points of bodies.
WITH_LEVERS = [
    int(kind)
    for kind in (
        mujoco.mjtConstraint.mjCNSTR_EQUALITY,
        mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS,
        mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL,
        mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC,
    )
]
_TURNED = ("body_quat", "geom_quat", "site_quat", "cam_quat")
_MOVED = ("body_pos", "body_ipos", "geom_pos", "site_pos", "jnt_pos", "qpos_spring")
_ADDED = {
    "body_gravcomp": 0.5,
    "geom_margin": 0.01,
    "dof_armature": 0.05,
    "dof_frictionloss": 0.1,
    "dof_damping": 0.2,
    "actuator_armature": 0.05,
}


def drawn_field(mj_model: mujoco.MjModel, name: str, rng: np.random.Generator) -> np.ndarray:
    """Draw other values of a field, in C's layout."""
    if name == GRAVITY:
        return mj_model.opt.gravity + rng.normal(size=3)
    values = np.array(getattr(mj_model, name), dtype=np.float64)
    if name in _TURNED:
        values += 0.05 * rng.normal(size=values.shape)
        return values / np.linalg.norm(values, axis=-1, keepdims=True)
    if name == "qpos0":
        mujoco.mj_integratePos(mj_model, values, 0.02 * rng.normal(size=mj_model.nv), 1.0)
        return values
    if name in _MOVED:
        values += 0.02 * rng.normal(size=values.shape)
        # The world has no frame to move.
        if name.startswith("body"):
            values[0] = 0.0
        if name == "qpos_spring":
            mujoco.mj_normalizeQuat(mj_model, values)
        return values
    if name in _ADDED:
        values += _ADDED[name] * rng.uniform(0.0, 1.0, size=values.shape)
        if name == "body_gravcomp":
            values[0] = 0.0
        return values
    return values * rng.uniform(0.8, 1.2, size=values.shape)


def sayable(mj_model: mujoco.MjModel, name: str, values: np.ndarray) -> np.ndarray:
    """Return values of a field, in C's layout, as XML can say them; what XML cannot say is as in the model."""
    own = np.array(getattr(mj_model, name), dtype=np.float64) if name != GRAVITY else values
    if name in ("body_pos", "body_quat"):
        values[0] = own[0]
        starts = mj_model.body_jntadr[mj_model.body_jntnum > 0]
        is_free = mj_model.jnt_type[starts] == mujoco.mjtJoint.mjJNT_FREE
        # The compiler takes it for where the body starts.
        floating = mj_model.jnt_bodyid[starts[is_free]]
        values[floating] = own[floating]
    if name.startswith("dof_"):
        # All degrees of freedom of a joint have one value.
        return values[mj_model.jnt_dofadr[mj_model.dof_jntid]]
    if name == "jnt_pos":
        is_free = mj_model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        values[is_free] = own[is_free]
    if name == "geom_size":
        is_made = np.isin(
            mj_model.geom_type, (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)
        )
        values[is_made] = own[is_made]
    if name in ("qpos0", "qpos_spring"):
        is_scalar = np.isin(
            mj_model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        )
        places = mj_model.jnt_qposadr[is_scalar]
        own[places] = values[places]
        return own
    return values


def give_fields(
    world: World,
    fields: tuple[str, ...],
    rng: np.random.Generator,
    xml: str = "",
    sim: SimCfg | None = None,
) -> tuple[list[mujoco.MjModel], int]:
    """Draw fields of all worlds but the first.

    Args:
        world: whose worlds they are.
        fields: names of them.
        rng: from which they are drawn.
        xml: what the model was compiled from; empty where that is not known.
        sim: what was laid over its options.

    Returns:
        C's model of each world, and how many of them C compiled from XML that has the fields.
    """
    for row in range(1, world.num_envs):
        for name in fields:
            field = world.field(name)
            drawn = drawn_field(world.mj_model, name, rng)
            # Of three worlds two are such that C can compile them.
            if row % 2:
                drawn = sayable(world.mj_model, name, drawn)
            field[row] = torch.from_numpy(drawn).reshape(field[row].shape)
    if fields:
        world.set_const(fields)
    models = []
    compiled = 0
    for row in range(world.num_envs):
        mj_model = copy.copy(world.mj_model)
        if fields:
            values = {
                name: world.field(name)[row].numpy(force=True).astype(np.float64) for name in fields
            }
            write_fields(mj_model, values)
        if fields and row and xml and sim is not None:
            by_compiler = compiled_with(xml, sim, mj_model)
            compiled += by_compiler is not None
            mj_model = by_compiler or mj_model
        models.append(solved_well(mj_model))
    return models, compiled


def solved_well(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Let C solve the constraints of a model as well as it can, and return the model.

    Bodies that C gives no weight have the weight that our worlds give them: without it, C's forces are rounding errors.
    """
    weights = mj_model.body_invweight0[:, 0]
    weights[:] = np.maximum(weights, least_weights(mj_model))
    mj_model.opt.tolerance = 0.0
    mj_model.opt.iterations = 100
    mj_model.opt.ls_iterations = 100
    return mj_model


def drawn_state(mj_model: mujoco.MjModel, rng: np.random.Generator, *, forces: bool) -> Arrays:
    """Draw a state: a keyframe's or a random one, after some steps, in which things may have come to rest."""
    mj_data = mujoco.MjData(mj_model)
    if mj_model.nkey and rng.random() < 0.5:
        mujoco.mj_resetDataKeyframe(mj_model, mj_data, 0)
    else:
        mujoco.mj_integratePos(mj_model, mj_data.qpos, 0.15 * rng.normal(size=mj_model.nv), 1.0)
        mj_data.qvel[:] = 0.5 * rng.normal(size=mj_model.nv)
    mj_data.ctrl[:] = poses.random_ctrl(mj_model, rng)
    mj_data.mocap_pos[:] += 0.05 * rng.normal(size=mj_data.mocap_pos.shape)
    if forces:
        mj_data.qfrc_applied[:] = 0.3 * rng.normal(size=mj_model.nv)
        mj_data.xfrc_applied[1:] = 0.3 * rng.normal(size=(mj_model.nbody - 1, 6))
    start = state_of(mj_data)
    with caught_warnings():
        mujoco.mj_step(mj_model, mj_data, int(rng.integers(0, 60)))
        reached = state_of(mj_data)
    unsteady = not np.isfinite(mj_data.qacc).all() or np.abs(mj_data.qvel).max(initial=0.0) > 30.0
    return start if unsteady or mj_data.time == 0.0 else reached


def state_of(mj_data: mujoco.MjData) -> Arrays:
    """Return C's state, rounded to float32."""
    state = {}
    for name in STATE:
        value = np.array(getattr(mj_data, name))
        state[name] = value if value.dtype == bool else value.astype(np.float32).astype(np.float64)
    # Time is a sum of steps, which float32 rounds at each.
    state["time"] = np.zeros(())
    return state


def state_of_row(world: World, row: int) -> Arrays:
    """Return the state of one world in C's layout."""
    mj_data = mujoco.MjData(world.mj_model)
    for name in STATE:
        target = np.asarray(getattr(mj_data, name))
        # Time begins at zero.
        if name != "time" and target.size:
            target[:] = world.view(name)[row].numpy(force=True).reshape(target.shape)
    return state_of(mj_data)


def perturbed(state: Mapping[str, np.ndarray], rng: np.random.Generator) -> Arrays:
    """Return a state whose numbers are rounded once more."""
    found = dict(state)
    for name in (
        "qpos",
        "qvel",
        "act",
        "ctrl",
        "mocap_pos",
        "qfrc_applied",
        "xfrc_applied",
        "plastic",
    ):
        value = state[name]
        sign = rng.choice((-1.0, 1.0), size=value.shape)
        found[name] = value + ROUNDING * sign * np.maximum(1.0, np.abs(value))
    return found


def rounded(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose numbers are those that float32 has."""
    found = copy.copy(mj_model)
    for name in dir(found):
        value = None if name.startswith("_") else getattr(found, name)
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            value[:] = value.astype(np.float32)
    return found


def jacobian_rounding(mj_model: mujoco.MjModel, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return by how much rounding of the Jacobian changes the constraints' force on each joint, in N or N m, [nv].

    Deep contacts press with up to 1e5 N where no joint gives way, and a part of that in a rounded Jacobian does, on the
    joints that the two bodies hang from. Rows of limits and dry friction have no levers that are rounded.
    """
    # Sparse rows say which joints those are.
    mj_model = copy.copy(mj_model)
    mj_model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    mj_data = put(state, mj_model)
    mujoco.mj_forward(mj_model, mj_data)
    pressing = np.zeros(mj_model.nv)
    for row in np.flatnonzero(np.isin(mj_data.efc_type, WITH_LEVERS)):
        start = mj_data.efc_J_rowadr[row]
        joints = mj_data.efc_J_colind[start : start + mj_data.efc_J_rownnz[row]]
        pressing[joints] += abs(mj_data.efc_force[row])
    lever = float(mj_model.stat.meansize)
    return ROUNDING * lever * pressing


def put(state: Mapping[str, np.ndarray], mj_model: mujoco.MjModel) -> mujoco.MjData:
    """Return C's data in a state, as after a reset."""
    mj_data = mujoco.MjData(mj_model)
    for name, value in state.items():
        if name == "time":
            mj_data.time = float(value)
        else:
            getattr(mj_data, name)[:] = value
    return mj_data


def put_all(world: World, states: list[Arrays]) -> None:
    """Reset all worlds and put each into its state."""
    everywhere = torch.ones(world.num_envs, dtype=torch.bool, device=world.device)
    world.reset(everywhere)
    put_rows(world, states, list(range(world.num_envs)))


def put_rows(world: World, states: list[Arrays], rows: list[int]) -> None:
    """Put some worlds into states."""
    for name in STATE:
        view = world.view(name)
        for row in rows:
            value = torch.as_tensor(states[row][name]).to(view)
            view[row] = value.reshape(view[row].shape)
