"""MuJoCo's DC motor with a filter, back-EMF, a limited voltage and dry friction, in the small robot of `hidden.py`."""

from dataclasses import dataclass

import mujoco
import numpy as np

from tests.identification import hidden


@dataclass(frozen=True, kw_only=True)
class SecretMotor:
    """One kind of motor in both joints.

    Attributes:
        stiffness, damping: of the firmware's law, which asks for efforts, N m/rad and N m s/rad.
        torque_constant: N m/A, and as much V s/rad, behind the gear.
        resistance: ohm.
        lag_s: inductance over resistance.
        voltage: V, of the battery.
        frictionloss: of the gear, N m.
        delay_s: of commands.
    """

    stiffness: float = 22.0
    damping: float = 0.4
    torque_constant: float = 1.1
    resistance: float = 0.9
    lag_s: float = 0.006
    voltage: float = 5.0
    frictionloss: float = 0.5
    delay_s: float = 0.008


def commands(seconds: float, rate: float = 500.0) -> tuple[np.ndarray, np.ndarray]:
    """Return times [T] and targets [T, 2] which ask for more than the motor can do, at times."""
    time_T = np.arange(0.0, seconds, 1.0 / rate)
    rng = np.random.default_rng(0)
    columns = []
    for middle in (0.1, -0.9):
        hz_W = rng.uniform(0.2, 4.0, 12)
        phase_W = rng.uniform(0.0, 2.0 * np.pi, 12)
        waves_TW = np.sin(2.0 * np.pi * hz_W * time_T[:, None] + phase_W)
        columns.append(middle + waves_TW @ (0.2 / hz_W**0.7))
    return time_T, np.stack(columns, axis=1)


def follow(
    secret: SecretMotor, time_T: np.ndarray, asked_TN: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return true positions and efforts behind the gear, both [T, 2], by plain `mj_step`."""
    model = _model(secret)
    data = mujoco.MjData(model)
    data.qpos[:] = asked_TN[0]
    pos_TN = np.empty_like(asked_TN)
    effort_TN = np.empty_like(asked_TN)
    line = 0
    for step in range(round(time_T[-1] / hidden.PHYSICS_S) + 1):
        now = step * hidden.PHYSICS_S
        arrived = np.searchsorted(time_T, now - secret.delay_s + 1e-9, side="right") - 1
        error_N = asked_TN[max(arrived, 0)] - data.qpos
        wanted_N = secret.stiffness * error_N - secret.damping * data.qvel
        voltage_N = wanted_N * secret.resistance / secret.torque_constant
        data.ctrl[:] = np.clip(voltage_N, -secret.voltage, secret.voltage)
        reads = line < len(time_T) and now >= time_T[line] - 1e-9
        if reads:
            pos_TN[line] = data.qpos
        mujoco.mj_step(model, data)
        if reads:
            # Of the step that begins at the reading. Without limits only dry friction constrains.
            effort_TN[line] = data.qfrc_actuator + data.qfrc_constraint
            line += 1
    return pos_TN, effort_TN


def _model(secret: SecretMotor) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(hidden.MODEL)
    free = [joint for joint in spec.joints if not joint.name]
    for element in [*spec.keys, *spec.actuators, *free]:
        spec.delete(element)
    spec.option.timestep = hidden.PHYSICS_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for name in hidden.JOINTS:
        spec.joint(name).frictionloss = secret.frictionloss
        spec.joint(name).limited = mujoco.mjtLimited.mjLIMITED_FALSE
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_dcmotor(
            motorconst=[secret.torque_constant, secret.torque_constant],
            resistance=secret.resistance,
            inductance=[secret.lag_s * secret.resistance, 0.0],
        )
    return spec.compile()
