"""Launches MuJoCo Warp's implicit integrators with all derivatives of the forces on simple bodies.

The inertia matrix of such a body has a diagonal alone: rows of `M` leave out the others, and MuJoCo Warp's derivatives
with them. C has these for "implicit", and with both integrators for a single body, whose only joint is a free one. For
that one MuJoCo Warp leaves out all that actuators and tendons do, too, whether it is simple or not. Here rows have an
entry for each ancestor of a degree of freedom.
"""

import dataclasses
from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import kernels, upstream

_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rows:
    """Rows of a matrix as large as the inertia matrix, in one array.

    Attributes:
        start, count: where the row of each degree of freedom starts, and how many entries it has, int [nv].
        column: of each entry, int [N].
        entry: of a row and a column, or -1, int [nv, nv].
    """

    start: np.ndarray
    count: np.ndarray
    column: np.ndarray
    entry: np.ndarray


def rows_of_ancestors(mj_model: mujoco.MjModel) -> Rows:
    """Return rows with an entry for each ancestor of a degree of freedom, from the root on, and then itself."""
    m = mj_model
    count = np.zeros(m.nv, dtype=np.int32)
    columns: list[int] = []
    entry = np.full((m.nv, m.nv), -1, dtype=np.int32)
    for dof in range(m.nv):
        # From the degree of freedom up to the root, then reversed.
        row = [dof]
        while m.dof_parentid[row[-1]] >= 0:
            row.append(int(m.dof_parentid[row[-1]]))
        row.reverse()
        entry[dof, row] = np.arange(len(columns), len(columns) + len(row))
        count[dof] = len(row)
        columns += row
    # Rows lie one after the other in one array.
    start = (np.cumsum(count) - count).astype(np.int32)
    return Rows(start=start, count=count, column=np.array(columns, dtype=np.int32), entry=entry)


def full_rows_matter(mj_model: mujoco.MjModel, warp_model: mjw.Model) -> bool:
    """Return whether an implicit integrator leaves out derivatives that C has."""
    # Lone bodies lack the derivatives of actuators and tendons in either integrator.
    if warp_model.body_freeadr.size and _may_act_on_lone_bodies(mj_model):
        return True
    acts = mj_model.nu > 0 or mj_model.ntendon > 0 or bool(warp_model.has_fluid)
    # A simple body's rows are shorter than its ancestors are many.
    is_simple = bool((mj_model.M_rownnz < rows_of_ancestors(mj_model).count).any())
    return acts and is_simple and warp_model.opt.integrator == mjw.IntegratorType.IMPLICIT


def _may_act_on_lone_bodies(mj_model: mujoco.MjModel) -> bool:
    """Return whether there are tendons, or actuators of anything but hinges, slides and balls."""
    is_of_joint = np.isin(mj_model.actuator_trntype, _JOINTS)
    joints = mj_model.actuator_trnid[is_of_joint, 0]
    is_of_free_joint = mj_model.jnt_type[joints] == mujoco.mjtJoint.mjJNT_FREE
    return mj_model.ntendon > 0 or not is_of_joint.all() or bool(is_of_free_joint.any())


def implicit_with_full_rows(
    mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data
) -> Callable[[], None]:
    """Return a launcher of an implicit integrator.

    Args:
        warp_model: the model that it takes, in which nothing is disabled that has a derivative.
        warp_data_E: the worlds, with the controls that gains are multiplied by.
    """
    m = warp_model
    d = warp_data_E
    rows = rows_of_ancestors(mj_model)
    full = _with_rows(mj_model, m, rows)
    # The inertia matrix in full rows, [E, N], which entries absent from `M` leave zero.
    inertia_E = wp.zeros((d.nworld, rows.column.size), dtype=float)
    full_E = dataclasses.replace(d, M=inertia_E)
    # For each entry of `M`, its place among the full rows.
    stored = np.zeros(mj_model.nC, dtype=np.int32)
    for dof in range(mj_model.nv):
        first = mj_model.M_rowadr[dof]
        place = slice(first, first + mj_model.M_rownnz[dof])
        stored[place] = rows.entry[dof, mj_model.M_colind[place]]
    places = wp.array(stored, dtype=int)
    # Of single bodies, derivatives by actuators alone are added to the inertia before they are solved for.
    lone = wp.array(_entries_of_lone_bodies(m, rows.start, rows.count), dtype=int)
    by_actuators = _without_other_derivatives(full)
    slowed_E = wp.zeros_like(inertia_E)

    def spread() -> None:
        # Entries that `M` does not have were written by the substep before.
        inertia_E.zero_()
        wp.launch(kernels.spread_columns, dim=d.M.shape, inputs=[places, d.M], outputs=[inertia_E])
        if lone.size == 0:
            return
        # The solver of single bodies adds the other derivatives to this matrix.
        upstream.derivative_of_smooth_forces(by_actuators, full_E, slowed_E)
        dim = (d.nworld, lone.size)
        wp.launch(kernels.copy_columns, dim=dim, inputs=[lone, slowed_E], outputs=[inertia_E])

    if m.opt.integrator == mjw.IntegratorType.IMPLICIT:

        def integrate() -> None:
            spread()
            mjw.implicit(full, full_E)

        return integrate
    # MuJoCo Warp's "implicitfast" solves in the rows of `M`, so only single bodies take full rows.
    entries = _entries_of_lone_bodies(m, mj_model.M_rowadr, mj_model.M_rownnz)
    stored_lone = wp.array(entries, dtype=int)
    system_E = wp.zeros_like(d.M)
    factor_E = wp.zeros_like(d.qLD)
    diagonal_E = wp.zeros_like(d.qLDiagInv)
    qacc_E = wp.zeros_like(d.qacc)

    def integrate_fast() -> None:
        spread()
        upstream.derivative_of_smooth_forces(m, d, system_E)
        # Lone bodies are solved for with these rows too, in vain: nothing may make them indefinite.
        dim = (d.nworld, stored_lone.size)
        wp.launch(kernels.copy_columns, dim=dim, inputs=[stored_lone, d.M], outputs=[system_E])
        upstream.factor_and_solve(m, d, system_E, factor_E, diagonal_E, qacc_E, d.efc.Ma)
        upstream.solve_for_lone_bodies(full, full_E, d.efc.Ma, qacc_E, solve=True)
        upstream.advance(m, d, qacc_E)

    return integrate_fast


def _with_rows(mj_model: mujoco.MjModel, warp_model: mjw.Model, rows: Rows) -> mjw.Model:
    """Return a model whose matrices have these rows."""
    # `D` is the full, unsymmetric matrix: both triangles look up the same entry here.
    of_full_matrix = np.full(mj_model.nD, -1, dtype=np.int32)
    for dof in range(mj_model.nv):
        first = mj_model.D_rowadr[dof]
        for place in range(first, first + mj_model.D_rownnz[dof]):
            other = mj_model.D_colind[place]
            of_full_matrix[place] = rows.entry[max(dof, other), min(dof, other)]
    return dataclasses.replace(
        warp_model,
        nC=rows.column.size,
        M_rownnz=wp.array(rows.count, dtype=int),
        M_rowadr=wp.array(rows.start, dtype=int),
        M_colind=wp.array(rows.column, dtype=int),
        M_elemid=wp.array(rows.entry, dtype=int),
        mapM2D=wp.array(of_full_matrix, dtype=int),
    )


def _entries_of_lone_bodies(
    warp_model: mjw.Model, start: np.ndarray, count: np.ndarray
) -> np.ndarray:
    """Return the entries of single bodies in rows that start at `start` and have `count` entries, int [N]."""
    found = [np.zeros(0, dtype=np.int32)]
    for body in warp_model.body_freeadr.numpy():
        first = warp_model.body_dofadr.numpy()[body]
        # A free joint has six degrees of freedom.
        for dof in range(first, first + 6):
            found.append(np.arange(start[dof], start[dof] + count[dof], dtype=np.int32))
    return np.concatenate(found)


def _without_other_derivatives(warp_model: mjw.Model) -> mjw.Model:
    """Return a model in which forces depend on velocities by actuators and tendons alone."""
    m = warp_model
    return dataclasses.replace(
        m,
        dof_damping=wp.zeros_like(m.dof_damping),
        dof_dampingpoly=wp.zeros_like(m.dof_dampingpoly),
        # Of actuators that add damping to a joint.
        jnt_actuatorid=wp.full_like(m.jnt_actuatorid, -1),
        has_fluid=False,
    )
