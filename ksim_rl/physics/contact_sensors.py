"""This module reads contact sensors, and the forces that contacts exert on bodies, from each world's list of contacts.

MuJoCo Warp sums and chooses in the order in which its threads come, which on a GPU is another one in each run.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

import dataclasses

import mujoco
import mujoco_warp as mjw
import warp as wp

from ksim_rl.physics import upstream
from ksim_rl.physics.rows.contact_lists import ContactLists
from ksim_rl.physics.structs import filled, struct_with

# The `intprm` of the two kinds: bits of mjtConDataField, the reduction of several contacts, and the number of slots.
_FOUND, _FORCE, _POSITION, _NORMAL, _TANGENT = 1 << 0, 1 << 1, 1 << 4, 1 << 5, 1 << 6
NET = (_FOUND | _FORCE | _POSITION, 3, 1)
# A single contact's force is in the axes of that contact, which are needed to turn it.
STRONGEST = (NET[0] | _NORMAL | _TANGENT, 2, 1)
NOTHING, *ELEMENTS = (
    int(getattr(mujoco.mjtObj, f"mjOBJ_{name}")) for name in ("UNKNOWN", "GEOM", "BODY", "XBODY")
)
SUMS = wp.constant(NET[1])
LEAST = wp.constant(float(mujoco.mjMINVAL))


def read_by_us(mj_model: mujoco.MjModel) -> list[int]:
    """Return the contact sensors that the kernel reads: the kinds of `ContactSensor`, without delay and cutoff."""
    return [
        sensor
        for sensor in range(mj_model.nsensor)
        if mj_model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_CONTACT
        and tuple(mj_model.sensor_intprm[sensor, :3].tolist()) in (NET, STRONGEST)
        and mj_model.sensor_objtype[sensor] in ELEMENTS
        and mj_model.sensor_reftype[sensor] in (NOTHING, *ELEMENTS)
        and not mj_model.sensor_history[sensor].any()
        and not mj_model.sensor_cutoff[sensor]
    ]


@struct_with(
    ("", ContactLists, "count ids"),
    ("", mjw.Option, "cone"),
    ("", mjw.Model, "body_parentid geom_bodyid sensor_objtype sensor_objid sensor_reftype sensor_refid"),
    ("", mjw.Model, "sensor_intprm sensor_adr"),
    ("contact_", mjw.Contact, "pos frame friction dim geom efc_address adhesion"),
    ("efc_", mjw.Constraint, "force"),
    ("", mjw.Data, "njmax nacon xipos xfrc_applied sensordata"),
)
class Problem:
    """What the kernels read and write, the sensors that they read, and the lists of contacts."""

    sensors: wp.array[int]
    forces: wp.array2d[wp.spatial_vector]


class ContactReadings:
    """What a substep reads of its contacts once their forces are known.

    Attributes:
        sensors: the ids of the sensors that `read_sensors` reads, and MuJoCo Warp need not.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data, lists: ContactLists
    ) -> None:
        m, d = warp_model, warp_data_E
        self.sensors = read_by_us(mj_model)
        own = {
            "sensors": wp.array(self.sensors, dtype=int, device=d.qpos.device),
            "forces": wp.empty_like(d.xfrc_applied),
        }
        contacts = {f"contact_{name}": array for name, array in vars(d.contact).items()}
        self._problem = filled(Problem, own, lists, contacts, {"efc_force": d.efc.force}, m.opt, m, d)
        # The same arrays, but the forces of contacts are among those that users apply, and it has no pool of contacts.
        self._without_pool = dataclasses.replace(d, xfrc_applied=own["forces"], naconmax=0)
        self._lists = lists

    def list(self) -> None:
        """List each world's contacts, where no kernel of constraint rows has."""
        self._lists.append()
        self._lists.order()

    def read_sensors(self) -> None:
        """Write the sensors that contacts match; the others have to be zero before."""
        if self.sensors:
            dim = (self._problem.count.shape[0], len(self.sensors))
            wp.launch(read_contact_sensors, dim=dim, inputs=[self._problem])

    def rne_postconstraint(self, warp_model: mjw.Model) -> None:
        """Do what MuJoCo Warp's function of that name does; only what equalities and tendons exert has no order."""
        wp.launch(add_contact_forces, dim=self._problem.forces.shape, inputs=[self._problem])
        mjw.rne_postconstraint(warp_model, self._without_pool)


@wp.func
def force_of(p: Problem, world: int, contact: int, in_world_frame: bool) -> wp.spatial_vector:
    """Return the force and torque of a contact on its second geom."""
    return upstream.contact_force_fn(
        p.cone,
        p.contact_frame,
        p.contact_friction,
        p.contact_dim,
        p.contact_efc_address,
        p.contact_adhesion,
        p.efc_force,
        p.njmax,
        p.nacon,
        world,
        contact,
        in_world_frame,
    )


@wp.kernel(enable_backward=False)
def add_contact_forces(p: Problem):
    """Add what a body's contacts exert on it, at its center of mass, to what users apply there."""
    world, body = wp.tid()
    total = p.xfrc_applied[world, body]
    for i in range(p.count[world]):
        contact = p.ids[world, i]
        body1, body2 = p.geom_bodyid[p.contact_geom[contact][0]], p.geom_bodyid[p.contact_geom[contact][1]]
        sign = float(body == body2) - float(body == body1)
        if sign != 0.0:
            wrench = sign * force_of(p, world, contact, True)
            force = wp.spatial_top(wrench)
            arm = p.contact_pos[contact] - p.xipos[world, body]
            total += wp.spatial_vector(force, wp.spatial_bottom(wrench) + wp.cross(arm, force))
    p.forces[world, body] = total


@wp.kernel(enable_backward=False)
def read_contact_sensors(p: Problem):
    """Read a sensor of a world as the C engine does: of equally strong contacts the first of the list counts."""
    world, place = wp.tid()
    sensor = p.sensors[place]
    kind, element = p.sensor_objtype[sensor], p.sensor_objid[sensor]
    other_kind, other = p.sensor_reftype[sensor], p.sensor_refid[sensor]
    is_net = p.sensor_intprm[sensor, 1] == SUMS
    # Warp: a variable that changes in a loop.
    found, size, sign, most = float(0.0), float(0.0), float(1.0), float(-1.0)  # noqa: UP018
    force, pos, frame = wp.vec3(0.0), wp.vec3(0.0), wp.mat33(0.0)
    for i in range(p.count[world]):
        contact = p.ids[world, i]
        geom, geom2 = p.contact_geom[contact][0], p.contact_geom[contact][1]
        body, body2 = p.geom_bodyid[geom], p.geom_bodyid[geom2]
        # In the direction of the contact, or against it.
        along = upstream.is_of(p.body_parentid, body, geom, kind, element)
        along = along and upstream.is_of(p.body_parentid, body2, geom2, other_kind, other)
        against = upstream.is_of(p.body_parentid, body2, geom2, kind, element)
        against = against and upstream.is_of(p.body_parentid, body, geom, other_kind, other)
        if along or against:
            found += 1.0
            wrench = force_of(p, world, contact, False)
            own_force, own_sign = wp.spatial_top(wrench), wp.where(along, 1.0, -1.0)
            if is_net:
                weight = wp.length(own_force)
                size += weight
                pos += weight * p.contact_pos[contact]
                force += wp.transpose(p.contact_frame[contact]) @ (own_sign * own_force)
            elif wp.dot(own_force, own_force) > most:
                most = wp.dot(own_force, own_force)
                sign, force = own_sign, own_force
                pos = p.contact_pos[contact]
                frame = p.contact_frame[contact]
    if found == 0.0:
        return
    if is_net:
        pos = pos / wp.max(size, LEAST)
    else:
        # Its axes are turned with it, all but the second tangent.
        force = wp.vec3(force[0], force[1], sign * force[2])
    at = p.sensor_adr[sensor]
    p.sensordata[world, at] = found
    for i in range(3):
        p.sensordata[world, at + 1 + i] = force[i]
        p.sensordata[world, at + 4 + i] = pos[i]
        if not is_net:
            p.sensordata[world, at + 7 + i] = sign * frame[0, i]
            p.sensordata[world, at + 10 + i] = sign * frame[1, i]
