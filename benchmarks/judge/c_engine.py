"""What MuJoCo's C engine reaches from a state, by the name of each quantity that a view or a sensor shows."""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np

from benchmarks.judge import accepted
from benchmarks.judge.worlds import Arrays, put
from ksim_rl.physics.refresh import COLLISION_SENSORS

REACHED = ("qpos", "qvel", "act", "time", "plastic")
LAST = (
    "qacc",
    "act_dot",
    "actuator_force",
    "qfrc_actuator",
    "qfrc_passive",
    "qfrc_constraint",
    "actuator_length",
    "actuator_velocity",
)
OF_BODIES = ("cacc", "cfrc_int", "cfrc_ext")
REFRESHED = (
    "xpos",
    "xquat",
    "xmat",
    "xipos",
    "ximat",
    "xanchor",
    "xaxis",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
    "subtree_com",
    "cinert",
    "cvel",
    "ten_length",
    "ten_velocity",
    "cam_xpos",
    "cam_xmat",
    "light_xpos",
    "light_xdir",
    "subtree_linvel",
    "subtree_angmom",
    "qfrc_bias",
)
# What reads contacts, or distances of the collision pass.
KEPT = [
    int(kind)
    for kind in (*COLLISION_SENSORS, mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtSensor.mjSENS_TOUCH)
]
ACCELERATION = int(mujoco.mjtStage.mjSTAGE_ACC)


def run(
    mj_model: mujoco.MjModel, state: Mapping[str, np.ndarray], substeps: int
) -> tuple[Arrays, mujoco.MjData]:
    """Return the quantities after `substeps` by name, and C's data; sensors as "sensor NAME" and "sensor NAME later".

    The first are of the last substep, the second what they are in the state that it reached, as World.refresh says.
    """
    mj_model = copy.copy(mj_model)
    # With it C's sensors of kinetic energy read the evaluation before (docs/upstream.md).
    mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    mj_data = put(state, mj_model)
    for _ in range(substeps - 1):
        mujoco.mj_step(mj_model, mj_data)
    before = mujoco.MjData(mj_model)
    mujoco.mj_copyData(before, mj_model, mj_data)
    mujoco.mj_step(mj_model, mj_data)
    found = {name: np.array(getattr(mj_data, name), dtype=np.float64) for name in (*REACHED, *LAST)}
    last = mj_data.sensordata.copy()
    if mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_NATIVECCD:
        _measure_by_native_search(mj_model, before, last)
    mujoco.mj_forward(mj_model, before)
    mujoco.mj_rnePostConstraint(mj_model, before)
    found |= {name: np.array(getattr(before, name)) for name in OF_BODIES}
    after = mujoco.MjData(mj_model)
    mujoco.mj_copyData(after, mj_model, mj_data)
    refresh(mj_model, after)
    found |= {name: np.array(getattr(after, name)) for name in REFRESHED}
    for sensor in range(mj_model.nsensor):
        columns = columns_of(mj_model, sensor)
        later = last if is_kept(mj_model, sensor) else after.sensordata
        found[f"sensor {name_of(mj_model, sensor)}"] = last[columns].copy()
        found[f"sensor {name_of(mj_model, sensor)} later"] = later[columns].copy()
    return found, mj_data


def touched_accepted(
    mj_model: mujoco.MjModel, state: Mapping[str, np.ndarray], substeps: int
) -> bool:
    """Return whether contacts that may differ are there in a substep before the last one."""
    mj_data = put(state, mj_model)
    for _ in range(substeps - 1):
        mujoco.mj_step(mj_model, mj_data)
        if accepted.depths_in_c(mj_data):
            return True
    return False


def refresh(mj_model: mujoco.MjModel, mj_data: mujoco.MjData) -> None:
    """Compute what follows from positions and velocities."""
    mujoco.mj_fwdPosition(mj_model, mj_data)
    mujoco.mj_sensorPos(mj_model, mj_data)
    mujoco.mj_fwdVelocity(mj_model, mj_data)
    mujoco.mj_sensorVel(mj_model, mj_data)
    mujoco.mj_subtreeVel(mj_model, mj_data)
    # Where trees may sleep, C leaves what tracks them from a body that never moves (docs/upstream.md).
    awake = copy.copy(mj_model)
    awake.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    mujoco.mj_camlight(awake, mj_data)


def _measure_by_native_search(
    mj_model: mujoco.MjModel, mj_data: mujoco.MjData, sensordata: np.ndarray
) -> None:
    """Write what distance sensors read with C's own search: without it they are off by centimetres, or find nothing."""
    native = copy.copy(mj_model)
    native.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    measured = mujoco.MjData(native)
    mujoco.mj_copyData(measured, native, mj_data)
    mujoco.mj_fwdPosition(native, measured)
    mujoco.mj_sensorPos(native, measured)
    for sensor in np.flatnonzero(np.isin(mj_model.sensor_type, COLLISION_SENSORS)):
        columns = columns_of(mj_model, int(sensor))
        # A reading that is delayed is of another state.
        if not np.any(mj_model.sensor_history[sensor] > 0):
            sensordata[columns] = measured.sensordata[columns]


def is_kept(mj_model: mujoco.MjModel, sensor: int) -> bool:
    """Whether a refresh leaves a sensor as the last substep had it."""
    if mj_model.sensor_needstage[sensor] == ACCELERATION or np.any(
        mj_model.sensor_history[sensor] > 0
    ):
        return True
    return int(mj_model.sensor_type[sensor]) in KEPT


def columns_of(mj_model: mujoco.MjModel, sensor: int) -> slice:
    """Return the columns of a sensor in sensordata."""
    start = int(mj_model.sensor_adr[sensor])
    return slice(start, start + int(mj_model.sensor_dim[sensor]))


def name_of(mj_model: mujoco.MjModel, sensor: int) -> str:
    """Return the type and name of a sensor, which say what a fault is about."""
    kind = mujoco.mjtSensor(mj_model.sensor_type[sensor]).name.removeprefix("mjSENS_").lower()
    return f"{kind} {mj_model.sensor(sensor).name}"
