"""Launches the kernels of a substep before and after its constraints: smooth dynamics and integration.

MuJoCo Warp launches some 35 kernels for the first and some 10 for the second, each of which waits for its slowest
world; here some lanes of a warp own a world, with its bodies or its inertia matrix in shared memory. They are written
in C++, as the solver's kernel is; the CPU compiles the same source, for one lane. Read SMOOTH and
INTEGRATION.

Source of the algorithms: https://mujoco.readthedocs.io/en/stable/computation/index.html
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import native
from ksim_rl.physics.actuators.disabled_actuators import SWITCHED_OFF
from ksim_rl.physics.fixed_geoms import fixed_geoms
from ksim_rl.physics.overflow import OUT_OF, record_arrays
from ksim_rl.physics.sim_cfg import SimCfg

SMOOTH = "ksim_rl/physics/smooth/smooth_dynamics.cuh"
INTEGRATION = "ksim_rl/physics/smooth/integration.cuh"
# The shared memory that a block has without asking for more, in floats.
SHARED_FLOATS = 48 * 1024 // 4
# Few worlds do not fill a GPU with 8 lanes each. Many have 8 where a block of two warps is small, so that shared memory
# does not limit how many run (32768 of Go1 on an H200 are integrated in 65 us, in 87 with 16; of G1 in 267 and 234). In
# small blocks dynamics take 56 registers, not the 72 that the compiler likes (Go1, 16 lanes: 154 us instead of 164).
LANES = (8, 16, 32)
LANES_OF_FEW = {SMOOTH: 16, INTEGRATION: 32}
SMALL_BLOCK_FLOATS = 3072
REGISTERS = 56
# Whether it writes where geoms are, goes on after that, and after the velocities to the inertia matrix and the forces,
# and whether others than a substep read what it writes. Or else it sums momenta of subtrees there, takes the worlds of
# a mask alone, or empties the pool of contacts where it places geoms.
WHOLE = {
    **dict.fromkeys(("places_geoms", "goes_on", "forces_too", "is_read"), True),
    **dict.fromkeys(("sums_momenta", "masked", "empties_pool"), False),
}
_TYPES = (
    "FREE",
    "BALL",
    "SLIDE",
    "HINGE",
    "JOINT",
    "JOINTINPARENT",
    "INTEGRATOR",
    "FILTER",
    "FILTEREXACT",
)
_NUMBERS = native.names_of(mujoco.mjtJoint, mujoco.mjtTrn, mujoco.mjtDyn)
_ENUMS = {
    **{name: _NUMBERS[name] for name in _TYPES},
    "AFFINE_GAIN": mujoco.mjtGain.mjGAIN_AFFINE,
    "AFFINE_BIAS": mujoco.mjtBias.mjBIAS_AFFINE,
    "SWITCHED_OFF": SWITCHED_OFF,
}
FORCE_CALLBACKS = ("passive", "control", "act_dyn", "act_gain", "act_bias")
HINGES = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
AFFINE = {
    mujoco.mjtTrn: ("JOINT", "JOINTINPARENT"),
    mujoco.mjtDyn: ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT"),
    mujoco.mjtGain: ("FIXED", "AFFINE"),
    mujoco.mjtBias: ("NONE", "AFFINE"),
}


def unsuited(warp_model: mjw.Model) -> str | None:
    """Return why the kernel cannot compute this model's smooth dynamics, or None where it can."""
    m = warp_model
    # The first reason that holds is the one that is reported.
    reasons = {
        "there are flexes": m.nflex > 0,
        "there are tendons": m.ntendon > 0,
        "there are no degrees of freedom": m.nv == 0,
        "there is a fluid": m.has_fluid,
        # Adhesion is a force of contacts, which the kernel does not know.
        "contacts adhere": bool(m.flg_adhesion),
        "joints yield": bool(m.nplastic),
        "an actuator is delayed": m.nhistory > 0,
        "an actuator is not affine or drives no hinge or slide": not _has_affine_actuators(m),
        "its bodies do not fit shared memory": _block(SMOOTH, _sizes(m), 1) is None,
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def calls_back(warp_model: mjw.Model) -> bool:
    """Whether a callback of MuJoCo Warp has a part in the forces."""
    return any(getattr(warp_model.callback, name) for name in FORCE_CALLBACKS)


def one_kernel_dynamics_unavailable(
    warp_model: mjw.Model, sim: SimCfg, *, solver_unavailable: str | None
) -> str | None:
    """Return why MuJoCo Warp's own kernels compute a model's smooth dynamics, or None where one kernel does."""
    on_gpu = warp_model.qpos0.device.is_cuda
    # On the CPU, MuJoCo Warp's stages are the default.
    if not (on_gpu if sim.one_kernel_dynamics is None else sim.one_kernel_dynamics):
        return f"sim.one_kernel_dynamics is {sim.one_kernel_dynamics}{'' if on_gpu else ', on the CPU'}"
    if solver_unavailable is not None:
        return "the constraints are not solved by one kernel"
    return unsuited(warp_model)


def one_kernel_integration_unavailable(
    warp_model: mjw.Model, *, dynamics_unavailable: str | None
) -> str | None:
    """Return why MuJoCo Warp's own kernels integrate, or None where one kernel does."""
    if dynamics_unavailable is None and warp_model.opt.integrator == mjw.IntegratorType.IMPLICIT:
        # "implicit" takes the derivative of Coriolis forces, too, which the kernel does not compute.
        return "the integrator is mjINT_IMPLICIT"
    return dynamics_unavailable


def smooth_dynamics(
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    lanes: int | None = None,
    mask: wp.array | None = None,
) -> Callable[..., None]:
    """Return a launcher of the smooth dynamics of a model that is not `unsuited`, with arrays in their final place.

    It does the work of MuJoCo Warp's `fwd_position`, `fwd_velocity`, `fwd_actuation` and `fwd_acceleration`, but for
    cameras, lights, contacts, constraint rows and `qacc_smooth`. With `forces_too=False` it computes of these what
    positions and velocities alone decide, and with `sums_momenta=True` what `subtree_vel` does as well; with
    `goes_on=False` only what collisions need, `geom_xpos` and `geom_xmat`; and with `places_geoms=False` all but these
    two. With `masked=True` it does so for the worlds of `mask`, bool [E]; with `is_read=False` it writes only what the
    other kernels of a substep read. `lanes` is how many threads share a world on CUDA; None takes the usual.
    """
    if mask is None:
        # An empty mask stands for all worlds: the kernel takes an array in any case.
        mask = wp.empty(0, dtype=bool, device=warp_data_E.qpos.device)
    launch = _launcher(SMOOTH, warp_model, warp_data_E, lanes, {"mask": mask})
    return partial(launch, **WHOLE)


def integration(
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    lanes: int | None = None,
    record: Mapping[str, wp.array] | None = None,
) -> Callable[[], None]:
    """Return a launcher of the integration of a model for which it is available: MuJoCo Warp's `euler` or `implicit`.

    It updates the arrays of a `record` of overflow, too. Each sum has one order, whatever the number of lanes. Where
    MuJoCo Warp differs from the C engine it follows C: with forces disabled (activations without actuation keep still,
    and implicitfast has the derivatives of what is left), and with controls out of range, whose derivative is taken at
    the clamped ones.
    """
    if record is None:
        record = record_arrays(warp_data_E.nworld)
    return _launcher(INTEGRATION, warp_model, warp_data_E, lanes, record)


def _launcher(
    header: str,
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    lanes: int | None,
    given: Mapping[str, wp.array],
) -> Callable[..., None]:
    m = warp_model
    d = warp_data_E
    sizes = _sizes(m)
    device = d.qpos.device
    # On the CPU one lane does the work of all.
    if device.is_cuda:
        if lanes:
            block = (lanes, 64)
        else:
            block = _block(header, sizes, d.nworld)
    else:
        block = (1, 1)
    assert block is not None, "the model is unsuited"
    lanes, threads = block
    # The degree of freedom that each actuator drives: all transmissions are joints here, see `unsuited`.
    driven = m.jnt_dofadr.numpy()[m.actuator_trnid.numpy()[:, 0]]
    # For each degree of freedom, its actuators are a slice of `drivers`, so that sums have one order.
    tables = {
        "moving_geoms": _moving_geoms(m),
        "first_driver": np.searchsorted(np.sort(driven), range(m.nv + 1)),
        "drivers": np.argsort(driven, kind="stable"),
        **_elimination(m),
    }
    arrays = {name: wp.array(table, dtype=int, device=device) for name, table in tables.items()}
    own = {**WHOLE, **given, **arrays}
    floats = _floats(header, sizes, lanes)
    constants = {
        **(_ENUMS | sizes),
        "floats": floats,
        "parents": m.body_parentid.numpy().tolist(),
        **(OUT_OF if header == INTEGRATION else {}),
    }
    # The bound was measured to pay for dynamics in small blocks; see LANES.
    is_small = header == SMOOTH and threads == 64 and floats * (64 // lanes) <= SMALL_BLOCK_FLOATS
    build = native.Build(max_registers=REGISTERS if is_small else None)
    return native.launcher_of(
        header, constants, own, m, d, lanes=lanes, threads=threads, build=build
    )


def _sizes(warp_model: mjw.Model) -> dict[str, int]:
    """Return the constants that are compiled into a model's kernels: sizes, and which features it uses."""
    m = warp_model
    flags = int(m.opt.disableflags)
    bits = mjw.DisableBit
    fast = m.opt.integrator == mjw.IntegratorType.IMPLICITFAST
    actuators_act = m.nactuator > 0 and not flags & bits.ACTUATION
    return {
        "num_bodies": m.nbody,
        "num_joints": m.njnt,
        "num_dofs": m.nv,
        "num_chains": m.nbranch,
        "num_moving_geoms": len(_moving_geoms(m)),
        "num_sites": m.nsite,
        "num_actuators": m.nactuator,
        "has_mocap": bool(m.nmocap),
        "has_activation": m.na > 0,
        "gravity": not flags & bits.GRAVITY,
        # MuJoCo Warp leaves it out with the springs and dampers.
        "lifts": not flags & bits.GRAVITY
        and not (flags & bits.SPRING and flags & bits.DAMPER)
        and (len(m.body_gravcomp) > 1 or bool(m.body_gravcomp.numpy().any())),
        "springs": not flags & bits.SPRING,
        "dampers": not flags & bits.DAMPER,
        "clamps_ctrl": not flags & bits.CLAMPCTRL,
        "actuators_act": actuators_act,
        "some_switched_off": bool((m.actuator_gaintype.numpy() == SWITCHED_OFF).any()),
        "num_entries": m.M_colind.size,
        "num_free_bodies": _num_free_bodies(m),
        "implicit_fast": fast and actuators_act,
        "solves": fast or not flags & (bits.EULERDAMP | bits.DAMPER),
        # Floats of the poses, then of inertias, then of sums of forces.
        "poses": max(10 * m.nbody, m.nactuator + m.nv),
        # Floats of the joints' frames, then of the bodies' velocities, then of momenta.
        "joints": 6 * max(m.nbody, m.njnt, m.nv),
    }


def _floats(header: str, sizes: Mapping[str, int], lanes: int) -> int:
    """Return how many floats the lanes of a world share."""
    needed = sizes["poses"] + sizes["joints"] + 9 * sizes["num_bodies"] + 6 * sizes["num_dofs"]
    if header == INTEGRATION:
        needed = sizes["num_entries"] + 2 * sizes["num_dofs"]
    # Worlds of a warp begin in other banks: floats of one world lie side by side for its lanes.
    return needed + (lanes - needed) % 32


def _num_free_bodies(warp_model: mjw.Model) -> int:
    """Return how many bodies have nothing but a free joint, and are solved for each on its own."""
    # Euler takes free bodies with all others.
    if warp_model.opt.integrator == mjw.IntegratorType.EULER:
        return 0
    return warp_model.body_freeadr.size


def _elimination(warp_model: mjw.Model) -> dict[str, Sequence[int] | np.ndarray]:
    """Return the dofs to eliminate, the last first, those in no other's row, and the entries that each changes."""
    m = warp_model
    # A change packs the entry that it changes and two places of the row, of 7 bits each, into one int.
    changes = []
    first = [0]
    # Free bodies are solved on their own, outside of this elimination.
    alone = m.body_freeadr.numpy()[: _num_free_bodies(m)]
    # From leaves to roots, as the sparse factorization of an inertia matrix goes: it has no fill-in then.
    order = np.flatnonzero(~np.isin(m.dof_bodyid.numpy(), alone))[::-1]
    # Rows of `M` have a column for each ancestor and, last, for the degree of freedom itself.
    row = m.M_hinit_i.numpy()
    column = m.M_colind.numpy()
    starts = m.M_rowadr.numpy()
    for dof in order:
        *ancestors, _ = column[row == dof]
        # The outer product of a row updates the rows of its ancestors.
        for other, ancestor in enumerate(ancestors):
            changes += [
                starts[ancestor] + place << 14 | place << 7 | other for place in range(other + 1)
            ]
            # Entries beyond the matrix belong to the right-hand side, which is eliminated with it.
            changes.append(column.size + ancestor << 14 | other << 7 | len(ancestors))
        first.append(len(changes))
    # Lanes substitute back along the chains of these in parallel.
    leaves = np.setdiff1d(order, column[row != column])
    return {"eliminated": order, "leaves": leaves, "changes": changes, "first_change": first}


def _has_affine_actuators(warp_model: mjw.Model) -> bool:
    # MuJoCo Warp's types are compared by number; a switched-off actuator has one of our own.
    m = warp_model
    for enum, names in AFFINE.items():
        known = [SWITCHED_OFF, *(native.names_of(enum)[name] for name in names)]
        if not np.isin(
            getattr(m, f"actuator_{enum.__name__[3:].lower()}type").numpy(), known
        ).all():
            return False
    # Balls and free joints have transmissions of several columns.
    return bool(np.isin(m.jnt_type.numpy()[m.actuator_trnid.numpy()[:, 0]], HINGES).all())


def _block(header: str, sizes: Mapping[str, int], worlds: int) -> tuple[int, int] | None:
    """Return the fewest lanes that suit so many worlds, and threads of a block, whose worlds fit shared memory."""
    is_few = worlds <= native.FEW_WORLDS
    least = LANES_OF_FEW[header] if is_few else 0
    for threads, lanes in itertools.product((32,) if is_few else (64, 32), LANES):
        if lanes == 8:
            # Eight lanes pay only where shared memory does not limit the blocks; see LANES.
            most = SMALL_BLOCK_FLOATS
        else:
            most = SHARED_FLOATS
        if lanes >= least and _floats(header, sizes, lanes) * (threads // lanes) <= most:
            return lanes, threads
    return None


def _moving_geoms(warp_model: mjw.Model) -> np.ndarray:
    """Return the geoms whose place `make_data` does not fix."""
    return np.flatnonzero(~fixed_geoms(warp_model))
