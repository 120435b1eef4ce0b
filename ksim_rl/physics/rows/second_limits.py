"""Adds the second row of a joint or tendon both of whose limits hold, which MuJoCo Warp leaves out.

A limit holds within its margin, so that both do where the range is narrower than twice that. MuJoCo Warp makes a row of
the nearer one only; C makes one of each, the lower first.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false, reportAttributeAccessIssue=false

from collections.abc import Callable, Collection

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics.structs import filled, struct_with
from ksim_rl.physics.upstream import efc_row

LIMIT_JOINT = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT))
LIMIT_TENDON = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON))
OUT_OF_NONZEROS = wp.constant(int(mjw.OverflowType.NJMAX_NNZ))


@struct_with(
    (
        "",
        mjw.Model,
        "nv is_sparse jnt_qposadr jnt_dofadr jnt_solref jnt_solimp jnt_range jnt_margin dof_invweight0 ten_J_rownnz "
        "ten_J_rowadr ten_J_colind tendon_solref_lim tendon_solimp_lim tendon_range tendon_margin tendon_invweight0",
    ),
    ("", mjw.Option, "timestep disableflags"),
    ("", mjw.Data, "qpos qvel ten_J ten_length njmax njmax_nnz ne nf nl nefc overflow"),
    (
        "efc_",
        mjw.Constraint,
        "type id jtdaj_adr jtdaj_nrow jtdaj_nblock J_rownnz J_rowadr J_colind J pos margin D vel aref frictionloss",
    ),
)
class Limits:
    """The arrays of a model and its worlds that the kernel reads, and the rows to which it adds."""

    joints: wp.array[int]
    tendons: wp.array[int]
    has_blocks: bool
    is_discrete: bool


def _narrow(
    limited: np.ndarray, ranges: np.ndarray, margins: np.ndarray, *, differs: bool
) -> np.ndarray:
    """Return the limited elements that may be near both limits at once, in the model or with fields per world."""
    # Fields per world may be drawn at any time, so their present width proves nothing.
    differs = differs or len(ranges) > 1 or len(margins) > 1
    width = ranges[0, :, 1] - ranges[0, :, 0]
    # Both hold together only where the range is narrower than both margins.
    both = (width < 2.0 * margins[0]) | differs
    return limited[both[limited]]


def joints_between_limits(warp_model: mjw.Model, expanded: Collection[str]) -> np.ndarray:
    """Return the hinges and slides both of whose limits may hold."""
    m = warp_model
    differs = bool({"jnt_range", "jnt_margin"}.intersection(expanded))
    limited = m.jnt_limited_slide_hinge_adr.numpy()
    return _narrow(limited, m.jnt_range.numpy(), m.jnt_margin.numpy(), differs=differs)


def tendons_between_limits(warp_model: mjw.Model, expanded: Collection[str]) -> np.ndarray:
    """Return the tendons both of whose limits may hold."""
    m = warp_model
    differs = bool({"tendon_range", "tendon_margin"}.intersection(expanded))
    limited = m.tendon_limited_adr.numpy()
    return _narrow(limited, m.tendon_range.numpy(), m.tendon_margin.numpy(), differs=differs)


def room_for_nonzeros(
    warp_model: mjw.Model, expanded: Collection[str], *, njmax: int
) -> int | None:
    """Return how many entries of the Jacobian a world needs room for, or None where MuJoCo Warp's estimate will do.

    That has one row for each limit, and none for dry friction that the model itself does not have.
    """
    # Rows of the second limits, and of friction that a world draws, are unknown to MuJoCo Warp's estimate.
    between = (
        joints_between_limits(warp_model, expanded).size
        + tendons_between_limits(warp_model, expanded).size
    )
    if between or {"dof_frictionloss", "tendon_frictionloss"}.intersection(expanded):
        # Every row may have all columns: an upper bound that needs no look at the tree.
        return njmax * warp_model.nv
    return None


def adding_of_second_limits(
    warp_model: mjw.Model, warp_data_E: mjw.Data, expanded: Collection[str]
) -> Callable[[], None] | None:
    """Return a launcher for after MuJoCo Warp's rows, with arrays in their final place; None if no row lacks."""
    m = warp_model
    d = warp_data_E
    bits = mjw.DisableBit
    joints = joints_between_limits(m, expanded)
    tendons = tendons_between_limits(m, expanded)
    # C makes no rows of limits under these flags either.
    if not joints.size + tendons.size or m.opt.disableflags & (bits.CONSTRAINT | bits.LIMIT):
        return None
    own = {
        "joints": wp.array(joints, dtype=int, device=d.qpos.device),
        "tendons": wp.array(tendons, dtype=int, device=d.qpos.device),
        # MuJoCo Warp's own Newton solver adds up blocks of rows.
        "has_blocks": m.is_sparse and m.opt.solver == mjw.SolverType.NEWTON,
        "is_discrete": m.opt.integrator == mjw.IntegratorType.DISCRETE,
    }
    limits = filled(Limits, own, m, m.opt, d)

    def add() -> None:
        wp.launch(add_second_limits, dim=d.nworld, inputs=[limits], device=d.qpos.device)

    return add


@wp.func
def _slot_of(world: int, kind: int, owner: int, c: Limits) -> int:
    """Return the row of the nearer limit, or -1 if there was no room for it."""
    # Rows stand in the order equality, friction, limits; `ne`, `nf` and `nl` count them, even beyond the room.
    first = c.ne[world] + c.nf[world]
    for row in range(first, wp.min(first + c.nl[world], c.njmax)):
        if c.efc_type[world, row] == kind and c.efc_id[world, row] == owner:
            return row
    return -1


@wp.func
def _free_address(world: int, rows: int, c: Limits) -> int:
    """Return the address behind the nonzeros of the present rows."""
    address = int(0)  # noqa: UP018 (Warp: a variable that changes in a loop)
    # Nonzeros of a row are contiguous, but rows need not be in the order of their addresses.
    for row in range(wp.min(rows, c.njmax)):
        address = wp.max(address, c.efc_J_rowadr[world, row] + c.efc_J_rownnz[world, row])
    return address


@wp.func
def _appended(world: int, nonzeros: int, c: Limits) -> int:
    """Return a new row, the last of all, and count it; -1 if there is no room for it."""
    row = c.nefc[world]
    address = int(0)  # noqa: UP018
    if c.is_sparse:
        # The row's entries go behind all others.
        address = _free_address(world, row, c)
        if address + nonzeros > c.njmax_nnz:
            c.overflow[world] = c.overflow[world] | OUT_OF_NONZEROS
            return -1
    # Counted before the check, so that the report of overflow knows how many rows were needed.
    c.nefc[world] = row + 1
    if row >= c.njmax:
        return -1
    if c.is_sparse:
        c.efc_J_rowadr[world, row] = address
        c.efc_J_rownnz[world, row] = nonzeros
    if c.has_blocks:
        # A block of one row, so that the solver adds this row up as it does the others.
        block = c.efc_jtdaj_nblock[world]
        c.efc_jtdaj_nblock[world] = block + 1
        c.efc_jtdaj_adr[world, block] = row
        c.efc_jtdaj_nrow[world, block] = 1
    return row


@wp.func
def _write_limit(
    world: int, row: int, kind: int, owner: int, distance: float, sign: float, c: Limits
):
    """Write a row of a limit: the Jacobian of its joint or tendon, times the sign of the side, and its law."""
    velocity = float(0.0)  # noqa: UP018
    # A dense row may hold leftovers of another step's row.
    if not c.is_sparse:
        for dof in range(c.nv):
            c.efc_J[world, row, dof] = 0.0
    # The Jacobian of a hinge or slide has one entry, of 1 or -1.
    if kind == LIMIT_JOINT:
        dof = c.jnt_dofadr[owner]
        velocity = sign * c.qvel[world, dof]
        if c.is_sparse:
            c.efc_J[world, 0, c.efc_J_rowadr[world, row]] = sign
            c.efc_J_colind[world, 0, c.efc_J_rowadr[world, row]] = dof
        else:
            c.efc_J[world, row, dof] = sign
        margin = c.jnt_margin[world % c.jnt_margin.shape[0], owner]
        invweight = c.dof_invweight0[world % c.dof_invweight0.shape[0], dof]
        solref = c.jnt_solref[world % c.jnt_solref.shape[0], owner]
        solimp = c.jnt_solimp[world % c.jnt_solimp.shape[0], owner]
    # A tendon's Jacobian is a sparse row that the substep has computed.
    else:
        for i in range(c.ten_J_rownnz[owner]):
            entry = c.ten_J_rowadr[owner] + i
            dof = c.ten_J_colind[entry]
            value = sign * c.ten_J[world, entry]
            velocity += value * c.qvel[world, dof]
            if c.is_sparse:
                c.efc_J[world, 0, c.efc_J_rowadr[world, row] + i] = value
                c.efc_J_colind[world, 0, c.efc_J_rowadr[world, row] + i] = dof
            else:
                c.efc_J[world, row, dof] = value
        margin = c.tendon_margin[world % c.tendon_margin.shape[0], owner]
        invweight = c.tendon_invweight0[world % c.tendon_invweight0.shape[0], owner]
        solref = c.tendon_solref_lim[world % c.tendon_solref_lim.shape[0], owner]
        solimp = c.tendon_solimp_lim[world % c.tendon_solimp_lim.shape[0], owner]
    # The law of the row (D, aref) is MuJoCo Warp's own, so that both rows have it in common.
    efc_row(
        c.disableflags,
        world,
        c.timestep[world % c.timestep.shape[0]],
        row,
        distance - margin,
        distance - margin,
        invweight,
        solref,
        solimp,
        margin,
        velocity,
        0.0,
        kind,
        owner,
        c.is_discrete,
        0.0,
        c.efc_type,
        c.efc_id,
        c.efc_pos,
        c.efc_margin,
        c.efc_D,
        c.efc_vel,
        c.efc_aref,
        c.efc_frictionloss,
    )


@wp.func
def _add_second(
    world: int,
    kind: int,
    owner: int,
    value: float,
    bounds: wp.vec2,
    margin: float,
    nonzeros: int,
    c: Limits,
):
    # Distances to both limits, rad or m; a row exists below the margin.
    lower = value - bounds[0]
    upper = bounds[1] - value
    # MuJoCo Warp handles a single limit.
    if lower >= margin or upper >= margin:
        return
    # MuJoCo Warp's row may be of either side: it is written again as the lower one.
    slot = _slot_of(world, kind, owner, c)
    last = _appended(world, nonzeros, c)
    # Sensors of limits read the slot's, and C the lower one.
    if slot >= 0:
        _write_limit(world, slot, kind, owner, lower, 1.0, c)
    if last >= 0:
        _write_limit(world, last, kind, owner, upper, -1.0, c)


@wp.kernel(enable_backward=False)
def add_second_limits(c: Limits):
    """One thread for each world, so that the order of the rows is always the same; few worlds have any to add."""
    world = wp.tid()
    for i in range(c.joints.shape[0]):
        joint = c.joints[i]
        bounds = c.jnt_range[world % c.jnt_range.shape[0], joint]
        margin = c.jnt_margin[world % c.jnt_margin.shape[0], joint]
        _add_second(
            world, LIMIT_JOINT, joint, c.qpos[world, c.jnt_qposadr[joint]], bounds, margin, 1, c
        )
    for i in range(c.tendons.shape[0]):
        tendon = c.tendons[i]
        bounds = c.tendon_range[world % c.tendon_range.shape[0], tendon]
        margin = c.tendon_margin[world % c.tendon_margin.shape[0], tendon]
        nonzeros = c.ten_J_rownnz[tendon]
        _add_second(
            world, LIMIT_TENDON, tendon, c.ten_length[world, tendon], bounds, margin, nonzeros, c
        )
