"""Reads contact sensors, and the forces that contacts exert on bodies, from each world's list of contacts.

MuJoCo Warp sums and chooses in the order in which its threads come, which on a GPU is another one in each run. The
kernels are contact_readings.cuh and contact_forces.cuh. The first reads accelerometers as well, for which MuJoCo Warp
computes accelerations and forces of all bodies.
"""

import dataclasses

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import native
from ksim_rl.physics.rows.contact_lists import ContactLists

# The `intprm` of the two kinds: bits of mjtConDataField, the reduction of several contacts, and the number of slots.
_FOUND = 1 << 0
_FORCE = 1 << 1
_POSITION = 1 << 4
_NORMAL = 1 << 5
_TANGENT = 1 << 6
NET = (_FOUND | _FORCE | _POSITION, 3, 1)
# A single contact's force is in the axes of that contact, which are needed to turn it.
STRONGEST = (NET[0] | _NORMAL | _TANGENT, 2, 1)
# MuJoCo's contact sensor reads the type XBODY as the body with all its descendants.
_KINDS = {"nothing": "UNKNOWN", "geom": "GEOM", "body": "BODY", "subtree": "XBODY"}
MATCHED = {name: int(getattr(mujoco.mjtObj, f"mjOBJ_{theirs}")) for name, theirs in _KINDS.items()}


def read_by_us(mj_model: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Return the sensors that the kernel reads, without delay and cutoff: kinds of `ContactSensor`, accelerometers."""
    m = mj_model
    kinds = mujoco.mjtSensor
    objects = list(MATCHED.values())
    if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
        return [], []
    # The kernel writes plain readings: delays and cutoffs are left to MuJoCo Warp.
    plain = ~m.sensor_history.any(-1) & (m.sensor_cutoff == 0.0)
    known = (m.sensor_intprm[:, None, :3] == (NET, STRONGEST)).all(-1).any(-1)
    # A first object must be named; the second may be anything.
    known &= np.isin(m.sensor_objtype, objects[1:]) & np.isin(m.sensor_reftype, objects)
    of_contacts = plain & known & (m.sensor_type == kinds.mjSENS_CONTACT)
    accelerometers = plain & (m.sensor_type == kinds.mjSENS_ACCELEROMETER)
    return np.flatnonzero(of_contacts).tolist(), np.flatnonzero(accelerometers).tolist()


class ContactReadings:
    """Readings of contacts and of accelerations in a substep, once their forces are known.

    Attributes:
        sensors: the ids of the sensors that `read_sensors` reads, and MuJoCo Warp need not.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        warp_model: mjw.Model,
        warp_data_E: mjw.Data,
        lists: ContactLists,
    ) -> None:
        m = warp_model
        d = warp_data_E
        of_contacts, accelerometers = read_by_us(mj_model)
        # The order of the kernel's outputs: contact sensors, then accelerometers.
        self.sensors = of_contacts + accelerometers
        own = {
            **vars(lists),
            "sensors": wp.array(self.sensors, dtype=int, device=d.qpos.device),
            "forces": wp.empty_like(d.xfrc_applied),
            "accelerates": True,
        }
        # The same arrays, but the forces of contacts are among those that users apply, and it has no pool of contacts.
        self._without_pool = dataclasses.replace(d, xfrc_applied=own["forces"], naconmax=0)
        self._lists = lists
        of_rows = {"njmax": d.njmax, "elliptic": m.opt.cone == mjw.ConeType.ELLIPTIC}
        constants = {
            **(of_rows | MATCHED),
            "sensors": len(of_contacts),
            "accelerometers": len(accelerometers),
            "num_dofs": m.nv,
            "gravity": not m.opt.disableflags & mjw.DisableBit.GRAVITY,
            "sum": NET[1],
        }
        # Of 32768 worlds of Go1 on an H200 sensors are read in 52 us instead of 80, of G1 in 93 instead of 148.
        if d.qpos.device.is_cuda and d.nworld > native.FEW_WORLDS:
            lanes = 4
        else:
            lanes = lists.lanes
        threads = lists.threads
        readings = "ksim_rl/physics/sensors/contact_readings.cuh"
        self._read_sensors = native.launcher_of(
            readings, constants, own, m, d, lanes=lanes, threads=threads
        )
        constants = of_rows | {"bodies": m.nbody}
        forces = "ksim_rl/physics/sensors/contact_forces.cuh"
        self._sum_forces = native.launcher_of(
            forces, constants, own, m, d, lanes=lanes, threads=threads
        )

    def list(self) -> None:
        """List each world's contacts, if no kernel of constraint rows has done so."""
        # The collision pass was MuJoCo Warp's, which appends nothing.
        self._lists.are_appended = False
        self._lists.append()
        self._lists.order()

    def read_sensors(self, *, accelerometers: bool = True) -> None:
        """Write accelerometers, if wanted, and the sensors that contacts match; the others have to be zero before."""
        if self.sensors:
            self._read_sensors(accelerates=accelerometers)

    def rne_postconstraint(self, warp_model: mjw.Model) -> None:
        """Do the work of MuJoCo Warp's function of that name; only forces of equalities and tendons have no order."""
        # Forces of contacts are summed in a fixed order, then passed on as applied forces.
        self._sum_forces()
        mjw.rne_postconstraint(warp_model, self._without_pool)
