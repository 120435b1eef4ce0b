"""Turns a log into a simulated motor's inputs and efforts in each physics step: errors, velocities, efforts."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ksim_rl.identification.held_robot import HeldRobot
from ksim_rl.identification.joint_log import EFFORT, JointLog

Array = np.ndarray
SMOOTHING_S = 0.02
"""Readings within it are one cubic: encoders count in steps, whose differences would be no velocity."""
LEAST_READINGS = 5
"""For a cubic."""
STAMPS = 1.05
"""How much slower than physics steps the lines of a log may come, since clocks jitter."""


@dataclass(frozen=True, kw_only=True)
class MotorSignals:
    """Inputs and efforts of motors in S physics steps, for N joints in the order of the robot.

    Attributes:
        timestep: s.
        error_SN: commanded less true position at the beginning of a step, rad or m.
        vel_SN: rad/s or m/s, at the same time.
        effort_SN: in the middle of the step, N m or N: a simulation holds one effort for a whole step.
    """

    timestep: float
    error_SN: Float[Array, "S N"]
    vel_SN: Float[Array, "S N"]
    effort_SN: Float[Array, "S N"]


def motor_signals(robot: HeldRobot, log: JointLog, timestep: float) -> MotorSignals:
    """Return the signals of a log in steps of `timestep`, s; a ValueError names missing columns."""
    asked_TN = log.targets.by_kind.get("pos")
    if asked_TN is None:
        raise ValueError(
            "--nets: the log has no commanded positions, from which a network tells efforts: give "
            f"{robot.joint_names[0]}.target_position, ..."
        )
    for kind, values_TN in log.targets.by_kind.items():
        # A network sees positions only, so that these efforts would look like noise.
        if kind != "pos" and np.ptp(values_TN) > 0.0:
            raise ValueError(
                f"--nets: the log has commands of kind {kind!r}, which no network sees: command positions alone"
            )
    if log.effort_TN is None:
        raise ValueError(
            f"--nets: the log has no column {robot.joint_names[0] + '.' + EFFORT!r} of a measured effort (N m or N)"
        )
    reading_s = float(np.median(np.diff(log.time_T)))
    if reading_s > STAMPS * timestep:
        raise ValueError(
            f"--nets: the log has a line each {reading_s:g} s, and physics steps are {timestep:g} s: log as often"
        )
    time_S = np.arange(0.0, log.time_T[-1] - timestep, timestep)
    # A command holds until the next one.
    line_S = np.searchsorted(log.time_T, time_S + 1e-9, side="right") - 1
    pos_SN, vel_SN = _motion(log, reading_s, time_S)
    return MotorSignals(
        timestep=timestep,
        error_SN=asked_TN[line_S] - pos_SN,
        vel_SN=vel_SN,
        effort_SN=_between(time_S + 0.5 * timestep, log.time_T, log.effort_TN),
    )


def _motion(
    log: JointLog, reading_s: float, time_S: Float[Array, " S"]
) -> tuple[Float[Array, "S N"], Float[Array, "S N"]]:
    """Return positions and velocities by cubics through the readings about each moment."""
    filters = _filters()
    # The cubics are of equal steps, and stamps may jitter.
    even_T = np.arange(0.0, log.time_T[-1] + 0.5 * reading_s, reading_s)
    read_TN = _between(even_T, log.time_T, log.pos_TN)
    half = round(0.5 * SMOOTHING_S / reading_s)
    window = max(2 * half + 1, LEAST_READINGS)
    pos_TN = filters.savgol_filter(read_TN, window, 3, axis=0)
    vel_TN = filters.savgol_filter(read_TN, window, 3, deriv=1, delta=reading_s, axis=0)
    return _between(time_S, even_T, pos_TN), _between(time_S, even_T, vel_TN)


def _between(
    time_S: Float[Array, " S"], time_T: Float[Array, " T"], values_TN: Float[Array, "T N"]
) -> Float[Array, "S N"]:
    """Return values at other times, straight between those that are known."""
    columns = []
    for column_T in values_TN.T:
        columns.append(np.interp(time_S, time_T, column_T))
    return np.stack(columns, axis=1)


def _filters() -> Any:
    """Return SciPy's filters."""
    try:
        from scipy import signal
    except ImportError:
        raise ValueError("--nets needs SciPy: pip install 'ksim_rl[identify]'") from None
    return signal
