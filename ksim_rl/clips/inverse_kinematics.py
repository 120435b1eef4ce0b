"""Finds the joint positions that bring points of a robot to where they should be, on MuJoCo's C engine.

Damped least squares (Levenberg, 1944; for robots Wampler, 1986): of all small steps the one that reduces the weighted
squared errors most, with a price on the distance from a posture, so that coordinates that no goal asks for stay put.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from ksim_rl.checked import Checked, Count, NonNegative, Positive
from ksim_rl.checks import near

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class PoseGoal:
    """A site or body and where it should be in the world; a rotation of None leaves its orientation open.

    Attributes:
        name: of a site of the model, else of a body.
        pos_3: m.
        quat_4: (w, x, y, z), unit.
        weight, turn_weight: of an error of 1 m (one number, or one for each of x, y and z) and of 1 rad.
    """

    name: str
    pos_3: Float[Array, " 3"]
    quat_4: Float[Array, " 4"] | None = None
    weight: float | tuple[float, float, float] = 1.0
    turn_weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class ComGoal:
    """Where the robot's centre of mass should be, m; only the first `len(pos_N)` of x, y and z count."""

    pos_N: Float[Array, " N"]
    weight: float = 1.0


@dataclass(frozen=True, kw_only=True)
class SolverCfg(Checked):
    """Settings of the search: its length and its care.

    Attributes:
        damping: of steps where goals cannot be reached or say little, in units of the weights.
        max_step: rad or m by which one coordinate moves in a step.
        reach: m; points that are further from their goals pull as if they were so near, so that goals out of reach do
            not throw the robot about.
        tolerance: rad or m; a step below it ends the search.
    """

    iterations: Count = 60
    damping: NonNegative = 1e-4
    max_step: Positive = 0.3
    reach: Positive = 0.3
    tolerance: Positive = 1e-8


class InverseKinematics:
    """A solver for one model whose first joint may be free; positions stay within the joints' ranges."""

    def __init__(self, mj_model: mujoco.MjModel, cfg: SolverCfg | None = None) -> None:
        self.mj_model = mj_model
        # Data of its own: a search must not disturb a simulation of the same model.
        self.mj_data = mujoco.MjData(mj_model)
        self.cfg = cfg or SolverCfg()
        # Ranges are kept for hinges and slides; a free root has none.
        limited = np.flatnonzero(mj_model.jnt_limited)
        self._limited_qpos = mj_model.jnt_qposadr[limited]
        self._limited_dof = mj_model.jnt_dofadr[limited]
        self._low, self._high = mj_model.jnt_range[limited].T
        sites = {mj_model.site(i).name: (i, True) for i in range(mj_model.nsite)}
        bodies = {mj_model.body(i).name: (i, False) for i in range(mj_model.nbody)}
        # A site counts before a body of the same name.
        self._points = {**bodies, **sites}

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse names that are neither of a site nor of a body, by a ValueError."""
        for name in names:
            if name not in self._points:
                raise ValueError(
                    f"the model has no site or body {name!r}: {near(name, self._points)}"
                )

    def solve(
        self,
        goals: Sequence[PoseGoal | ComGoal],
        *,
        start_L: Float[Array, " L"],
        posture_L: Float[Array, " L"] | None = None,
        posture_weight_M: Float[Array, " M"] | float = 1e-2,
    ) -> Float[Array, " L"]:
        """Return the qpos near `start_L` that fulfils the goals best.

        `posture_L` (None: the start) is the qpos that coordinates return to where goals do not say otherwise, with a
        weight per degree of freedom.
        """
        model = self.mj_model
        data = self.mj_data
        cfg = self.cfg
        data.qpos[:] = start_L
        if posture_L is None:
            posture_L = start_L
        # Squared, as the cost is the sum of squared weighted errors.
        pull_M = np.broadcast_to(np.asarray(posture_weight_M, float) ** 2, model.nv)
        away_M = np.zeros(model.nv)
        step_M = np.zeros(model.nv)
        for _ in range(cfg.iterations):
            # Kinematics and centres of mass are all that the Jacobians below need.
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            rows, errors = zip(*(self._linear(goal) for goal in goals), strict=True)
            jacobian_NM = np.concatenate(rows)
            error_N = np.concatenate(errors)
            # Differences of orientations are rotation vectors, so this has nv numbers and not nq.
            mujoco.mj_differentiatePos(model, away_M, 1.0, data.qpos, posture_L)
            # Gauss-Newton with damping: H = J^T J + posture + damping, g = J^T e + posture errors.
            hessian_MM = jacobian_NM.T @ jacobian_NM + np.diag(pull_M + cfg.damping**2)
            gradient_M = jacobian_NM.T @ error_N + pull_M * away_M
            step_M[:] = np.linalg.solve(hessian_MM, gradient_M)
            # Joints at an end of their range would take a share of the step and be clipped: solve without
            # them.
            held = self._held(step_M)
            if held.size:
                free = np.setdiff1d(np.arange(model.nv), held)
                step_M[:] = 0.0
                step_M[free] = np.linalg.solve(hessian_MM[np.ix_(free, free)], gradient_M[free])
            # Shortened as a whole, so that the direction of the step stays.
            longest = np.abs(step_M).max()
            step_M *= min(1.0, cfg.max_step / max(longest, 1e-12))
            # Along the manifold: quaternions stay unit.
            mujoco.mj_integratePos(model, data.qpos, step_M, 1.0)
            data.qpos[self._limited_qpos] = np.clip(
                data.qpos[self._limited_qpos], self._low, self._high
            )
            # The length before shortening: a step that was cut is not the end.
            if longest < cfg.tolerance:
                break
        return data.qpos.copy()

    def _held(self, step_M: Array) -> Array:
        """Return the degrees of freedom that are at an end of their range and would be moved beyond it."""
        at_L = self.mj_data.qpos[self._limited_qpos]
        by_L = step_M[self._limited_dof]
        beyond = ((at_L <= self._low) & (by_L < 0.0)) | ((at_L >= self._high) & (by_L > 0.0))
        return self._limited_dof[beyond]

    def _linear(self, goal: PoseGoal | ComGoal) -> tuple[Array, Array]:
        """Return weighted rows of the Jacobian, and the weighted errors that a step should undo."""
        model = self.mj_model
        data = self.mj_data
        move_3M = np.zeros((3, model.nv))
        turn_3M = np.zeros((3, model.nv))
        if isinstance(goal, ComGoal):
            # Body 0 with all that hangs on it: the whole robot.
            mujoco.mj_jacSubtreeCom(model, data, move_3M, 0)
            count = len(goal.pos_N)
            # Only as many of x, y and z as the goal names.
            error = goal.pos_N - data.subtree_com[0][:count]
            return goal.weight * move_3M[:count], goal.weight * error
        number, is_site = self._points[goal.name]
        if is_site:
            mujoco.mj_jacSite(model, data, move_3M, turn_3M, number)
            pos_3 = data.site_xpos[number]
            quat_4 = np.empty(4)
            mujoco.mju_mat2Quat(quat_4, data.site_xmat[number])
        else:
            mujoco.mj_jacBody(model, data, move_3M, turn_3M, number)
            pos_3 = data.xpos[number]
            quat_4 = data.xquat[number]
        # One weight for all axes, or one for each.
        weight_3 = np.broadcast_to(goal.weight, 3)
        # Axes that do not count must not use up the reach below.
        away_3 = np.where(weight_3 > 0.0, goal.pos_3 - pos_3, 0.0)
        away_3 = away_3 * min(1.0, self.cfg.reach / max(float(np.linalg.norm(away_3)), 1e-12))
        rows = weight_3[:, None] * move_3M
        errors = weight_3 * away_3
        # Where the orientation is open, its three rows are left out.
        if goal.quat_4 is None:
            return rows, errors
        turn_3 = goal.turn_weight * _turn_between(quat_4, goal.quat_4)
        return np.concatenate((rows, goal.turn_weight * turn_3M)), np.concatenate((errors, turn_3))


def _turn_between(first_4: Array, second_4: Array) -> Array:
    """Return the rotation vector, world frame, rad, that turns one orientation into another."""
    back_4 = np.empty(4)
    between_4 = np.empty(4)
    turn_3 = np.empty(3)
    mujoco.mju_negQuat(back_4, first_4)
    # From the world's side, since turn_3M gives angular velocity in world axes.
    mujoco.mju_mulQuat(between_4, second_4, back_4)
    mujoco.mju_quat2Vel(turn_3, between_4, 1.0)
    return turn_3
