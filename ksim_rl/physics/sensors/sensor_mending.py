"""Reads the sensors that MuJoCo Warp and the C engine read differently, once forces are known.

It takes contacts as its threads come, where C has an order, and puts no bounds to touch sensors.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportArgumentType=false, reportCallIssue=false

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import native, upstream
from ksim_rl.physics.rows.contact_lists import ContactLists
from ksim_rl.physics.sensors.contact_sensors import MATCHED

_SITE_TYPES = ("SPHERE", "CAPSULE", "CYLINDER", "BOX")


@wp.kernel(enable_backward=False)
def bound_touch(
    sensors: wp.array[int],
    sensor_adr: wp.array[int],
    cutoff: wp.array[float],
    sensordata: wp.array2d[float],
):
    """Keep touch sensors within their cutoff."""
    world, place = wp.tid()
    address = sensor_adr[sensors[place]]
    sensordata[world, address] = wp.min(sensordata[world, address], cutoff[sensors[place]])


def contact_sensors_left(mj_model: mujoco.MjModel, read: list[int]) -> list[int]:
    """Return the contact sensors that are not among `read` and that no history delays; none where there are flexes.

    Contacts of flexes are in no list.
    """
    m = mj_model
    left = (m.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT) & ~m.sensor_history.any(-1)
    left[read] = False
    # Contacts of flexes are in no list, so that MuJoCo Warp reads all of them.
    if m.nflex:
        return []
    return np.flatnonzero(left).tolist()


def bounded_touch_sensors(mj_model: mujoco.MjModel) -> list[int]:
    """Return the touch sensors with a cutoff."""
    bounded = (mj_model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH) & (
        mj_model.sensor_cutoff > 0.0
    )
    return np.flatnonzero(bounded).tolist()


def mend_sensors(
    mj_model: mujoco.MjModel,
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    read: list[int],
    lists: ContactLists | None,
) -> list[int]:
    """Let MuJoCo Warp's sensors be followed by ours, in place, and return those that it need not read.

    `read` are the sensors that something else reads, and `lists` the contact lists, if something else makes them.
    """
    contact_sensors = contact_sensors_left(mj_model, read)
    hooks: list[Callable[[], None]] = []
    if contact_sensors:
        hooks.append(_reading_of(contact_sensors, warp_model, warp_data_E, lists))
    if bounded := bounded_touch_sensors(mj_model):
        hooks.append(_bounding_of(bounded, warp_model, warp_data_E))

    def after_sensors(warp_model: mjw.Model, warp_data_E: mjw.Data, stage: int) -> None:
        # Called after each stage; forces are known after the last.
        if stage == upstream.Stage.ACC:
            for hook in hooks:
                hook()

    if hooks:
        warp_model.callback.sensor = after_sensors
    return contact_sensors


def _bounding_of(
    sensors: list[int], warp_model: mjw.Model, warp_data_E: mjw.Data
) -> Callable[[], None]:
    m = warp_model
    d = warp_data_E
    inputs = [wp.array(sensors, dtype=int), m.sensor_adr, m.sensor_cutoff]
    dim = (d.nworld, len(sensors))
    return lambda: wp.launch(bound_touch, dim=dim, inputs=inputs, outputs=[d.sensordata])


def _reading_of(
    sensors: list[int], warp_model: mjw.Model, warp_data_E: mjw.Data, lists: ContactLists | None
) -> Callable[[], None]:
    m = warp_model
    d = warp_data_E
    # With our own rows the lists exist already, and are in order.
    if lists is None:
        of_contacts = ContactLists(m, d)
    else:
        of_contacts = lists
    own = {**vars(of_contacts), "sensors": wp.array(sensors, dtype=int, device=d.qpos.device)}
    site_types = {f"site_{name}": upstream.GEOM_TYPES[name] for name in _SITE_TYPES}
    constants = {
        **(MATCHED | site_types),
        "site": int(mujoco.mjtObj.mjOBJ_SITE),
        "njmax": d.njmax,
        "elliptic": m.opt.cone == mjw.ConeType.ELLIPTIC,
        "sensors": len(sensors),
    }
    header = "ksim_rl/physics/sensors/contact_slots.cuh"
    lanes = of_contacts.lanes
    threads = of_contacts.threads
    launch = native.launcher_of(header, constants, own, m, d, lanes=lanes, threads=threads)

    def read_sensors() -> None:
        if lists is None:
            of_contacts.append()
            of_contacts.order()
        launch()

    return read_sensors
