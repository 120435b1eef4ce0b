"""This module reads contact sensors, and the forces that contacts exert on bodies, from each world's list of contacts.

MuJoCo Warp sums and chooses in the order in which its threads come, which on a GPU is another one in each run. The
kernels are rows/wrench.cpp with rows/sensors.cpp, and with rows/bodies.cpp. The first reads accelerometers as well, for
which MuJoCo Warp computes accelerations and forces of all bodies.
"""

import dataclasses

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import native
from ksim_rl.physics.rows.contact_lists import ContactLists

# The `intprm` of the two kinds: bits of mjtConDataField, the reduction of several contacts, and the number of slots.
_FOUND, _FORCE, _POSITION, _NORMAL, _TANGENT = 1 << 0, 1 << 1, 1 << 4, 1 << 5, 1 << 6
NET = (_FOUND | _FORCE | _POSITION, 3, 1)
# A single contact's force is in the axes of that contact, which are needed to turn it.
STRONGEST = (NET[0] | _NORMAL | _TANGENT, 2, 1)
NOTHING, GEOM, BODY, SUBTREE = (
    int(getattr(mujoco.mjtObj, f"mjOBJ_{name}")) for name in ("UNKNOWN", "GEOM", "BODY", "XBODY")
)


def read_by_us(mj_model: mujoco.MjModel) -> list[int]:
    """Return the contact sensors that the kernel reads: the kinds of `ContactSensor`, without delay and cutoff."""
    return [
        sensor
        for sensor in range(mj_model.nsensor)
        if mj_model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_CONTACT
        and tuple(mj_model.sensor_intprm[sensor, :3].tolist()) in (NET, STRONGEST)
        and mj_model.sensor_objtype[sensor] in (GEOM, BODY, SUBTREE)
        and mj_model.sensor_reftype[sensor] in (NOTHING, GEOM, BODY, SUBTREE)
        and not mj_model.sensor_history[sensor].any()
        and not mj_model.sensor_cutoff[sensor]
    ]


def accelerometers(mj_model: mujoco.MjModel) -> list[int]:
    """Return the accelerometers that the kernel reads: those without delay and cutoff."""
    plain = ~mj_model.sensor_history.any(-1) & (mj_model.sensor_cutoff == 0.0)
    return np.flatnonzero(plain & (mj_model.sensor_type == mujoco.mjtSensor.mjSENS_ACCELEROMETER)).tolist()


class ContactReadings:
    """What a substep reads of its contacts, and of accelerations, once their forces are known.

    Attributes:
        sensors: the ids of the sensors that `read_sensors` reads, and MuJoCo Warp need not.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data, lists: ContactLists
    ) -> None:
        m, d = warp_model, warp_data_E
        of_contacts, of_accelerations = read_by_us(mj_model), accelerometers(mj_model)
        self.sensors = of_contacts + of_accelerations
        own = {
            **vars(lists),
            "sensors": wp.array(self.sensors, dtype=int, device=d.qpos.device),
            "forces": wp.empty_like(d.xfrc_applied),
        }
        # The same arrays, but the forces of contacts are among those that users apply, and it has no pool of contacts.
        self._without_pool = dataclasses.replace(d, xfrc_applied=own["forces"], naconmax=0)
        self._lists = lists
        constants = {
            **lists.constants,
            "njmax": d.njmax,
            "elliptic": m.opt.cone == mjw.ConeType.ELLIPTIC,
            "bodies": m.nbody,
            "sensors": len(of_contacts),
            "accelerometers": len(of_accelerations),
            "num_dofs": m.nv,
            "gravity": not m.opt.disableflags & mjw.DisableBit.GRAVITY,
            "sum": NET[1],
            "nothing": NOTHING,
            "geom": GEOM,
            "subtree": SUBTREE,
        }
        parts = ("sensors", "accelerometers"), ("bodies",)
        sources = [native.source_of("rows", ("layout", "wrench", *own_parts)) for own_parts in parts]
        self._read_sensors, self._sum_forces = (
            native.launcher(source, constants, own, m, d, lanes=lists.lanes, threads=lists.threads)
            for source in sources
        )

    def list(self) -> None:
        """List each world's contacts, where no kernel of constraint rows has."""
        self._lists.are_appended = False
        self._lists.append()
        self._lists.order()

    def read_sensors(self) -> None:
        """Write accelerometers and the sensors that contacts match; the others have to be zero before."""
        if self.sensors:
            self._read_sensors()

    def rne_postconstraint(self, warp_model: mjw.Model) -> None:
        """Do what MuJoCo Warp's function of that name does; only what equalities and tendons exert has no order."""
        self._sum_forces()
        mjw.rne_postconstraint(warp_model, self._without_pool)
