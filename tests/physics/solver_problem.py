"""The convex problem that a world's solver has, in float64: its cost, and what a step of Newton's would still save."""

from dataclasses import dataclass

import mujoco
import numpy as np

from ksim_rl.physics import World

_KINDS = mujoco.mjtConstraint
_RUBS = (_KINDS.mjCNSTR_FRICTION_DOF, _KINDS.mjCNSTR_FRICTION_TENDON)
# The most by which rounding to the nearest float32 changes a number, relative to it.
_ROUNDING = 2.0**-24


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Minimize 1/2 q' M q - q' qfrc_smooth + s(J q - aref); of each cone the rows, and mu and the frictions."""

    mass: np.ndarray
    smooth: np.ndarray
    jacobian: np.ndarray
    aref: np.ndarray
    kinds: np.ndarray
    stiffness: np.ndarray
    bounds: np.ndarray
    cones: tuple[tuple[np.ndarray, np.ndarray], ...]

    def cost(self, qacc: np.ndarray) -> float:
        """Return what accelerations cost."""
        return self._at(qacc)[0]

    def savings(self, qacc: np.ndarray) -> tuple[float, float]:
        """Return what a step of Newton's would save, first where float32 sees it, then in all other directions.

        With the Hessian H scaled to ones on its diagonal, its Cholesky factor in float32 is the exact factor of a
        matrix whose entries are off by up to (n + 1) 2^-24 or so (Higham, Accuracy and Stability of Numerical
        Algorithms, theorem 10.5), to which the rounding of H itself adds. In a direction whose eigenvalue is smaller, a
        solver knows neither the curvature nor even its sign: MuJoCo Warp's ends in NaN or meets a good pivot by luck,
        and ours leaves the direction out. So how far it gets there says nothing about a solver.
        """
        _, gradient, hessian = self._at(qacc)
        scale = 1.0 / np.sqrt(np.diag(hessian))
        eigenvalues, directions = np.linalg.eigh(hessian * np.outer(scale, scale))
        slopes, seen = directions.T @ (scale * gradient), eigenvalues > (len(qacc) + 1) * _ROUNDING
        # H is positive, but its eigenvalues in float64 are rounded too.
        saved = 0.5 * slopes**2 / np.maximum(eigenvalues, 1e-15)
        return float(saved[seen].sum()), float(saved[~seen].sum())

    def _at(self, qacc: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        # The cost, its gradient and its Hessian.
        residual = self.jacobian @ qacc - self.aref
        cost, slope, curvature = self._of_single_rows(residual)
        hessian = np.diag(curvature)
        for rows, friction in self.cones:
            of_cone = self._of_cone(rows, friction, residual[rows])
            cost[rows[0]], slope[rows], hessian[np.ix_(rows, rows)] = of_cone
        momentum = self.mass @ qacc
        return (
            float(0.5 * qacc @ momentum - qacc @ self.smooth + cost.sum()),
            momentum - self.smooth + self.jacobian.T @ slope,
            self.mass + self.jacobian.T @ hessian @ self.jacobian,
        )

    def _of_single_rows(self, residual: np.ndarray) -> tuple[np.ndarray, ...]:
        # Of the rows of cones zeros.
        D, rubs = self.stiffness, np.isin(self.kinds, _RUBS)
        cones = self.kinds == _KINDS.mjCNSTR_CONTACT_ELLIPTIC
        linear = rubs & (np.abs(residual) * D >= self.bounds)
        quadratic = (
            (self.kinds == _KINDS.mjCNSTR_EQUALITY)
            | (rubs & ~linear)
            | (~rubs & ~cones & (residual < 0.0))
        )
        at_bound = self.bounds * (np.abs(residual) - 0.5 * self.bounds / D)
        cost = np.where(quadratic, 0.5 * D * residual**2, np.where(linear, at_bound, 0.0))
        slope = np.where(
            quadratic, D * residual, np.where(linear, self.bounds * np.sign(residual), 0.0)
        )
        return cost, slope, np.where(quadratic, D, 0.0)

    def _of_cone(
        self, rows: np.ndarray, friction: np.ndarray, residual: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        D, mu, scaled = self.stiffness[rows], friction[0], friction * residual
        normal, tangent = scaled[0], np.linalg.norm(scaled[1:])
        zeros = np.zeros(len(rows))
        if normal >= mu * tangent:
            return 0.0, zeros, np.diag(zeros)
        if mu * normal + tangent <= 0.0:
            return float(0.5 * D @ residual**2), D * residual, np.diag(D)
        Dm, gap = D[0] / (mu**2 * (1.0 + mu**2)), normal - mu * tangent
        along = scaled[1:] / tangent
        of_gap, bend = np.concatenate([[1.0], -mu * along]), np.diag(zeros)
        bend[1:, 1:] = -mu * (np.eye(len(along)) - np.outer(along, along)) / tangent
        hessian = Dm * (np.outer(of_gap, of_gap) + gap * bend)
        return (
            float(0.5 * Dm * gap**2),
            friction * Dm * gap * of_gap,
            np.outer(friction, friction) * hessian,
        )


def problems(world: World) -> list[Problem]:
    """Return the problem of each world."""
    m, d = world.warp_model, world.warp_data_E
    names = "type id D aref frictionloss J_rownnz J_rowadr"
    read = {name: getattr(d.efc, name).numpy() for name in names.split()}
    columns, values = (
        array.numpy().reshape(world.num_envs, -1) for array in (d.efc.J_colind, d.efc.J)
    )
    frictions = d.contact.friction.numpy().astype(float)
    to_root = float(m.opt.impratio_invsqrt.numpy()[0])
    smooth, entries = d.qfrc_smooth.numpy().astype(float), d.M.numpy()
    rows, dofs = m.M_hinit_i.numpy(), m.M_colind.numpy()
    found = []
    for env, count in enumerate(d.nefc.numpy()):
        mass = np.zeros((m.nv, m.nv))
        mass[rows, dofs] = mass[dofs, rows] = entries[env].ravel()[: len(rows)]
        jacobian = np.zeros((count, m.nv))
        for row in range(count):
            here = slice(
                read["J_rowadr"][env, row], read["J_rowadr"][env, row] + read["J_rownnz"][env, row]
            )
            jacobian[row, columns[env, here]] = values[env, here]
        kinds, contacts = read["type"][env, :count], read["id"][env, :count]
        elliptic, cones = kinds == _KINDS.mjCNSTR_CONTACT_ELLIPTIC, []
        for contact in np.unique(contacts[elliptic]):
            of_cone = np.flatnonzero(elliptic & (contacts == contact))
            mu = frictions[contact, 0] * to_root
            cones.append((of_cone, np.array([mu, *frictions[contact, : len(of_cone) - 1]])))
        D, aref, bounds = (
            read[name][env, :count].astype(float) for name in ("D", "aref", "frictionloss")
        )
        found.append(
            Problem(
                mass=mass,
                smooth=smooth[env],
                jacobian=jacobian,
                aref=aref,
                kinds=kinds,
                stiffness=D,
                bounds=bounds,
                cones=tuple(cones),
            )
        )
    return found
