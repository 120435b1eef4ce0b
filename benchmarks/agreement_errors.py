"""Measures how far two runs of the same worlds are apart, per quantity, relative to its scale."""

import dataclasses

import mujoco
import numpy as np

CONTACT_LIMIT, FAR_LIMIT = 1e-3, 1e-2
COMPARED = ("qpos", "qvel", "xpos", "sensordata", "actuator_force", "qfrc_constraint")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Errors:
    """Relative errors of one quantity over the worlds."""

    median: float
    p95: float
    max: float
    share_within_1e_3: float
    share_within_1e_2: float
    scale: float
    worlds: int


def errors(actual: np.ndarray, expected: np.ndarray) -> Errors:
    """Compare one quantity [E, L]."""
    scale = _scale(expected)
    return _errors(np.abs(actual - expected).max(axis=1) / scale, scale)


def worst(several: list[Errors]) -> Errors:
    """Return the worst value of each statistic over all quantities."""
    return Errors(
        median=max(found.median for found in several),
        p95=max(found.p95 for found in several),
        max=max(found.max for found in several),
        share_within_1e_3=min(found.share_within_1e_3 for found in several),
        share_within_1e_2=min(found.share_within_1e_2 for found in several),
        scale=min(found.scale for found in several),
        worlds=several[0].worlds,
    )


def contact_columns(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the columns of all contact sensors in sensordata."""
    columns = [
        np.arange(columns.start, columns.stop)
        for kind, columns in zip(mj_model.sensor_type, sensor_columns(mj_model), strict=True)
        if kind == mujoco.mjtSensor.mjSENS_CONTACT
    ]
    return np.concatenate(columns) if columns else np.zeros(0, dtype=int)


def sensor_columns(mj_model: mujoco.MjModel) -> list[slice]:
    """Return the columns of each sensor in sensordata."""
    return [
        slice(int(adr), int(adr + dim))
        for adr, dim in zip(mj_model.sensor_adr, mj_model.sensor_dim, strict=True)
    ]


def compare(
    mj_model: mujoco.MjModel, actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]
) -> dict[str, Errors]:
    """Return the errors of each quantity that the model has."""
    found = {
        name: errors(actual[name], expected[name]) for name in COMPARED if np.any(expected[name])
    }
    sensors = [
        columns
        for columns in sensor_columns(mj_model)
        if np.any(expected["sensordata"][:, columns])
    ]
    if sensors:
        found["sensordata"] = worst(
            [
                errors(actual["sensordata"][:, columns], expected["sensordata"][:, columns])
                for columns in sensors
            ]
        )
    columns = contact_columns(mj_model)
    touching = np.abs(expected["sensordata"][:, columns]).max(axis=1, initial=0.0) > 0.0
    if touching.any():
        rows = np.ix_(touching, columns)
        found["contact_force"] = errors(actual["sensordata"][rows], expected["sensordata"][rows])
    return found


def _scale(expected: np.ndarray) -> float:
    largest = np.abs(expected).max(axis=1)
    return float(np.median(largest) or largest.max() or 1.0)


def _errors(relative: np.ndarray, scale: float) -> Errors:
    return Errors(
        median=float(np.median(relative)),
        p95=float(np.percentile(relative, 95)),
        max=float(relative.max()),
        share_within_1e_3=float(np.mean(relative <= CONTACT_LIMIT)),
        share_within_1e_2=float(np.mean(relative <= FAR_LIMIT)),
        scale=scale,
        worlds=len(relative),
    )
