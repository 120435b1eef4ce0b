"""Fits the numbers of joints to a log: simulated positions are brought to those that the encoders read.

MuJoCo's toolbox for system identification searches (Gauss-Newton with bounds) and gives the intervals. These assume
that what is left is noise, which it is not where a model lacks something. So they are at least as wide as intervals
that take seconds of the log as independent pieces (White, "Maximum likelihood estimation of misspecified models",
1982).
"""

import io
import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ksim_rl.identification.findings import Estimate, Findings
from ksim_rl.identification.free_numbers import FreeNumber, free_numbers, remark_of_sum, untold
from ksim_rl.identification.held_robot import KINDS, HeldRobot
from ksim_rl.identification.joint_log import JointLog
from ksim_rl.identification.simulation import Candidate, Simulation

Array = np.ndarray
SETTLING_S = 1.0
"""What the robot did before the log began is forgotten by then."""
# A first search uses a part of the log, so that the whole log is simulated only a few times.
FIRST_S = 6.0
MOST_STEPS = 15
LAST_STEPS = 6
DIFFERENCE = 1e-4
"""By how much numbers are changed for derivatives, in their scales: well above what solvers leave."""
PIECE_S = 1.0
NORMAL_95 = 1.96
WIDEST = 0.5
"""Half the interval over the number, or over its usual size: from there on the log does not tell it."""
MOST_UNEXPLAINED = 0.1
"""Share of a joint's motion."""


def fit(
    robot: HeldRobot, log: JointLog, *, note: Callable[[str], None] = lambda _: None
) -> Findings:
    """Return the numbers of a robot's joints by a log of them.

    The parts of a robot whose base is held are fitted one by one. A ValueError says that the extra is missing.
    """
    places = {name: place for place, name in enumerate(robot.joint_names)}
    joints: dict[str, dict[str, Estimate]] = {}
    unexplained: dict[str, float] = {}
    delays = []
    limbs = robot.limbs()
    for number, limb in enumerate(limbs, 1):
        note(f"part {number} of {len(limbs)}: {', '.join(limb.joint_names)}")
        part = log.part([places[name] for name in limb.joint_names])
        found = _fit_limb(limb, part)
        joints |= found.joints
        unexplained |= found.unexplained
        delays.append(found.delay_s)
    warnings = _doubts(log, unexplained, places)
    ordered = {name: joints[name] for name in robot.joint_names}
    return Findings(
        robot=robot.name,
        joints=ordered,
        delay_s=_joined(delays),
        unexplained={name: unexplained[name] for name in robot.joint_names},
        warnings=tuple(warnings),
    )


class Misfit:
    """The differences between read and simulated positions, as a function of the free numbers."""

    def __init__(
        self, robot: HeldRobot, log: JointLog, free: Sequence[FreeNumber], *, until_s: float
    ) -> None:
        self._free = free
        self._nominal_NP = robot.nominal_NP()
        chosen = log.time_T <= until_s
        self._time_R = log.time_T[chosen]
        self._pos_RN = log.pos_TN[chosen]
        self._counts = self._time_R >= SETTLING_S
        self._simulation = Simulation(robot, log.targets, num_candidates=len(free))

    @property
    def time_R(self) -> Float[Array, " R"]:
        """The times of the readings that count, s."""
        return self._time_R[self._counts]

    def candidate(self, x_P: Float[Array, " P"]) -> Candidate:
        """Return the numbers that a point of the search stands for."""
        numbers_NP = self._nominal_NP.copy()
        delay_s = 0.0
        for value, number in zip(x_P, self._free, strict=True):
            if number.joint is None:
                delay_s = float(value * number.scale)
            else:
                numbers_NP[number.joint, KINDS.index(number.kind)] = value * number.scale
        return Candidate(numbers_NP=numbers_NP, delay_s=delay_s)

    def __call__(self, x: Array, params: object) -> tuple[list[Array], list[Array], list[Array]]:
        """Return the differences as the toolbox takes them: [R * N] of a point [P], [R * N, K] of points [P, K]."""
        points = [self.candidate(x_P) for x_P in x.reshape(len(x), -1).T]
        found_KRN = self._simulation.positions(points, self._time_R, self._pos_RN[0])
        differences_KRN = (found_KRN - self._pos_RN)[:, self._counts]
        columns = differences_KRN.reshape(len(points), -1).T
        if x.ndim == 1:
            columns = columns[:, 0]
        return [columns], [], []


@dataclass(frozen=True, kw_only=True)
class _LimbFindings:
    joints: dict[str, dict[str, Estimate]]
    delay_s: Estimate
    unexplained: dict[str, float]


def _fit_limb(robot: HeldRobot, log: JointLog) -> _LimbFindings:
    sysid = _toolbox()
    free = free_numbers(robot, log.targets)
    params = sysid.ParameterDict()
    for number in free:
        params.add(sysid.Parameter(number.name, number.start, 0.0, number.highest))
    # It would print each step.
    how: dict[str, Any] = {
        "verbose": False,
        "output": io.StringIO(),
        "eps": DIFFERENCE,
        "xtol": 1e-3,
    }
    steps = MOST_STEPS
    if log.time_T[-1] > FIRST_S:
        first = Misfit(robot, log, free, until_s=FIRST_S)
        with _quiet():
            params, _ = sysid.optimize(params, first, max_iters=MOST_STEPS, **how)
        steps = LAST_STEPS
    whole = Misfit(robot, log, free, until_s=float(log.time_T[-1]))
    with _quiet():
        params, result = sysid.optimize(params, whole, max_iters=steps, **how)
    x_P = params.as_vector()
    left = whole(x_P, params)[0]
    _, as_noise_P = sysid.calculate_intervals(left, result.jac)
    left_RN = left[0].reshape(-1, len(robot.joints))
    half_P = np.maximum(as_noise_P, _by_pieces(left_RN, result.jac, whole.time_R))
    return _LimbFindings(
        joints=_estimates(robot, log, free, x_P, half_P),
        # The delay is the last of the free numbers.
        delay_s=_estimate(free[-1], x_P[-1], half_P[-1], ""),
        unexplained=dict(
            zip(robot.joint_names, np.sqrt(np.mean(left_RN**2, axis=0)).tolist(), strict=True)
        ),
    )


def _toolbox() -> Any:
    """Return MuJoCo's toolbox, whose module is empty where its own dependencies are missing."""
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        raise ValueError("ksim-rl identify needs MuJoCo's toolbox: pip install 'ksim_rl[identify]'")
    return sysid


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out the toolbox's warning of numbers near a bound: a damping near zero is no fault."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def _by_pieces(
    left_RN: Float[Array, "R N"], jacobian: Array, time_R: Float[Array, " R"]
) -> Float[Array, " P"]:
    """Return half widths from pieces of the log that count as independent, whatever is correlated within each."""
    hessian_PP = jacobian.T @ jacobian
    num_readings, num_joints = left_RN.shape
    per_reading = jacobian.reshape(num_readings, num_joints, -1)
    slope_RP = np.einsum("rn,rnp->rp", left_RN, per_reading)
    piece_R = ((time_R - time_R[0]) / PIECE_S).astype(int)
    starts = np.flatnonzero(np.diff(piece_R, prepend=-1))
    slope_BP = np.add.reduceat(slope_RP, starts, axis=0)
    inverse_PP = np.linalg.pinv(hessian_PP, hermitian=True)
    covariance_PP = inverse_PP @ (slope_BP.T @ slope_BP) @ inverse_PP
    return NORMAL_95 * np.sqrt(np.diag(covariance_PP))


def _estimates(
    robot: HeldRobot,
    log: JointLog,
    free: Sequence[FreeNumber],
    x_P: Float[Array, " P"],
    half_P: Float[Array, " P"],
) -> dict[str, dict[str, Estimate]]:
    found = {}
    for place, joint in enumerate(robot.joints):
        held = untold(joint, log.targets, place)
        remarks = remark_of_sum(joint, held)
        numbers = {kind: Estimate(remark=reason) for kind, reason in held.items()}
        for number, value, half in zip(free, x_P, half_P, strict=True):
            if number.joint == place:
                numbers[number.kind] = _estimate(number, value, half, remarks.get(number.kind, ""))
        found[joint.name] = {kind: numbers[kind] for kind in KINDS}
    return found


def _estimate(number: FreeNumber, value: float, half: float, remark: str) -> Estimate:
    # Compared to its usual size too: a damping near zero is identified, if it is identified as small.
    if not half <= WIDEST * max(value, 1.0):
        wide = f"the log leaves it open by +- {half * number.scale:.2g}: more motion, faster and slower"
        return Estimate(remark=wide)
    return Estimate(
        value=float(value * number.scale), half_width=float(half * number.scale), remark=remark
    )


def _joined(delays: Sequence[Estimate]) -> Estimate:
    """Return the mean of the parts' delays, each weighted by how well it is known; the interval holds their spread."""
    told = [delay for delay in delays if delay.is_told]
    if not told:
        return delays[0]
    value_K = np.array([delay.value for delay in told])
    half_K = np.maximum([delay.half_width for delay in told], 1e-6)
    weight_K = half_K**-2.0 / np.sum(half_K**-2.0)
    mean = float(weight_K @ value_K)
    # Parts of a robot may be late by different times.
    spread = float(np.abs(value_K - mean).max())
    return Estimate(value=mean, half_width=max(float(np.sum(half_K**-2.0) ** -0.5), spread))


def _doubts(log: JointLog, unexplained: dict[str, float], places: dict[str, int]) -> list[str]:
    """Return a line for each joint that the simulation does not follow."""
    found = []
    for name, left in unexplained.items():
        motion = float(np.std(log.pos_TN[:, places[name]]))
        if left > MOST_UNEXPLAINED * motion:
            found.append(
                f"joint {name!r}: {left / motion:.0%} of its motion is not explained, so its numbers mean little: is "
                "the base held as told, does nothing touch, are the units and the robot's masses right?"
            )
    return found
