"""Reads the sensors of joint and tendon limits: how far, how fast and how strongly a limit is violated.

MuJoCo Warp looks for them among the constraint rows, where it takes a joint for the tendon of the same number, and
which a refresh does not make. Distances and speeds follow from the state alone, as they do in C, whose row of a limit
has them; a limit that is farther away than its margin reads zero. Where both limits of a joint are near, C reads the
lower one's row.
"""

# Kernels are Python only in their spelling: wp.tid() gives as many indices as it is asked for.
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

_SENSORS = mujoco.mjtSensor
JOINT_POS = int(_SENSORS.mjSENS_JOINTLIMITPOS)
JOINT_VEL = int(_SENSORS.mjSENS_JOINTLIMITVEL)
JOINT_FRC = int(_SENSORS.mjSENS_JOINTLIMITFRC)
TENDON_POS = int(_SENSORS.mjSENS_TENDONLIMITPOS)
TENDON_VEL = int(_SENSORS.mjSENS_TENDONLIMITVEL)
TENDON_FRC = int(_SENSORS.mjSENS_TENDONLIMITFRC)
OF_STATE = (JOINT_POS, JOINT_VEL, TENDON_POS, TENDON_VEL)
OF_FORCES = (JOINT_FRC, TENDON_FRC)
POSITIVE = int(mujoco.mjtDataType.mjDATATYPE_POSITIVE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
JOINT_ROW = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
TENDON_ROW = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)
PI = wp.constant(float(np.pi))


class LimitSensors:
    """Launches the reading of a model's limit sensors, with arrays in their final place.

    Attributes:
        reads_tendons: whether one of them needs `ten_velocity`.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data
    ) -> None:
        self._warp_model = warp_model
        self._warp_data_E = warp_data_E
        # C reads zero under these flags; sensordata is zeroed before.
        bits = mujoco.mjtDisableBit
        without = bits.mjDSBL_SENSOR | bits.mjDSBL_CONSTRAINT | bits.mjDSBL_LIMIT
        reads_any = not int(mj_model.opt.disableflags) & without
        of_state = np.isin(mj_model.sensor_type, OF_STATE) & reads_any
        of_forces = np.isin(mj_model.sensor_type, OF_FORCES) & reads_any
        # A delayed sensor shows what it saw at a substep: no refresh may read it.
        present = of_state & ~mj_model.sensor_history.any(axis=-1)
        self._of_state = wp.array(np.flatnonzero(of_state), dtype=int)
        self._of_refresh = wp.array(np.flatnonzero(present), dtype=int)
        self._of_forces = wp.array(np.flatnonzero(of_forces), dtype=int)
        # One kernel reads all four kinds, by these two flags.
        is_speed = np.isin(mj_model.sensor_type, (JOINT_VEL, TENDON_VEL))
        is_of_tendon = np.isin(mj_model.sensor_type, (TENDON_POS, TENDON_VEL))
        self._is_speed = wp.array(is_speed, dtype=bool)
        self._is_of_tendon = wp.array(is_of_tendon, dtype=bool)
        self.reads_tendons = bool((present & is_speed & is_of_tendon).any())

    def read_state(self, *, in_refresh: bool = False) -> None:
        """Launch the reading of distances and speeds; a refresh leaves delayed ones alone."""
        m = self._warp_model
        d = self._warp_data_E
        if in_refresh:
            sensors = self._of_refresh
        else:
            sensors = self._of_state
        if sensors.size == 0:
            return
        inputs = [
            *(sensors, self._is_speed, self._is_of_tendon),
            *(m.sensor_datatype, m.sensor_objid, m.sensor_adr, m.sensor_cutoff),
            *(m.jnt_type, m.jnt_qposadr, m.jnt_dofadr, m.jnt_range, m.jnt_margin),
            *(m.tendon_range, m.tendon_margin, d.qpos, d.qvel, d.ten_length, d.ten_velocity),
        ]
        wp.launch(_read_state, dim=(d.nworld, sensors.size), inputs=inputs, outputs=[d.sensordata])

    def read_forces(self) -> None:
        """Launch the reading of forces, which the rows of the last solve have."""
        m = self._warp_model
        d = self._warp_data_E
        if self._of_forces.size == 0:
            return
        inputs = [
            *(
                self._of_forces,
                m.sensor_type,
                m.sensor_datatype,
                m.sensor_objid,
                m.sensor_adr,
                m.sensor_cutoff,
            ),
            *(d.ne, d.nf, d.nl, d.njmax, d.efc.type, d.efc.id, d.efc.force),
        ]
        wp.launch(
            _read_forces,
            dim=(d.nworld, self._of_forces.size),
            inputs=inputs,
            outputs=[d.sensordata],
        )


@wp.func
def _cut(value: float, cutoff: float, datatype: int) -> float:
    if cutoff <= 0.0:
        return value
    # A positive quantity has no lower bound but zero.
    if datatype == POSITIVE:
        return wp.min(value, cutoff)
    return wp.clamp(value, -cutoff, cutoff)


@wp.func
def _nearest(lower: float, upper: float, margin: float, rate: float, wants_speed: bool) -> float:
    """Return the number in a scalar's first row, of its lower limit or else its upper one; zero without rows."""
    # C's row of the lower limit comes first, and has the sign of the rate.
    if lower < margin:
        return rate if wants_speed else lower - margin
    if upper < margin:
        return -rate if wants_speed else upper - margin
    return 0.0


@wp.kernel(enable_backward=False)
def _read_state(
    sensors: wp.array[int],
    is_speed: wp.array[bool],
    is_of_tendon: wp.array[bool],
    sensor_datatype: wp.array[int],
    sensor_objid: wp.array[int],
    sensor_adr: wp.array[int],
    sensor_cutoff: wp.array[float],
    jnt_type: wp.array[int],
    jnt_qposadr: wp.array[int],
    jnt_dofadr: wp.array[int],
    jnt_range: wp.array2d[wp.vec2],
    jnt_margin: wp.array2d[float],
    tendon_range: wp.array2d[wp.vec2],
    tendon_margin: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ten_length: wp.array2d[float],
    ten_velocity: wp.array2d[float],
    sensordata: wp.array2d[float],
):
    world, place = wp.tid()
    sensor = sensors[place]
    of = sensor_objid[sensor]
    value = float(0.0)  # noqa: UP018 (Warp: a variable that changes)
    wants_speed = is_speed[sensor]
    if is_of_tendon[sensor]:
        limits = tendon_range[world % tendon_range.shape[0], of]
        length = ten_length[world, of]
        margin = tendon_margin[world % tendon_margin.shape[0], of]
        value = _nearest(
            length - limits[0], limits[1] - length, margin, ten_velocity[world, of], wants_speed
        )
    else:
        limits = jnt_range[world % jnt_range.shape[0], of]
        margin = jnt_margin[world % jnt_margin.shape[0], of]
        q = jnt_qposadr[of]
        v = jnt_dofadr[of]
        if jnt_type[of] == BALL:
            # Its one limit is of the angle by which it is turned, from a quaternion w x y z.
            turn = wp.normalize(
                wp.vec4(qpos[world, q], qpos[world, q + 1], qpos[world, q + 2], qpos[world, q + 3])
            )
            axis = wp.vec3(turn[1], turn[2], turn[3])
            sine = wp.length(axis)
            angle = 2.0 * wp.atan2(sine, turn[0])
            # The shorter way around.
            if angle > PI:
                angle -= 2.0 * PI
            direction = wp.sign(angle) * wp.normalize(axis)
            spin = wp.vec3(qvel[world, v], qvel[world, v + 1], qvel[world, v + 2])
            # A ball's range is one angle; the other number is zero.
            distance = wp.max(limits[0], limits[1]) - wp.abs(angle)
            if distance < margin:
                value = -wp.dot(direction, spin) if wants_speed else distance - margin
        else:
            at = qpos[world, q]
            value = _nearest(at - limits[0], limits[1] - at, margin, qvel[world, v], wants_speed)
    sensordata[world, sensor_adr[sensor]] = _cut(
        value, sensor_cutoff[sensor], sensor_datatype[sensor]
    )


@wp.kernel(enable_backward=False)
def _read_forces(
    sensors: wp.array[int],
    sensor_type: wp.array[int],
    sensor_datatype: wp.array[int],
    sensor_objid: wp.array[int],
    sensor_adr: wp.array[int],
    sensor_cutoff: wp.array[float],
    ne: wp.array[int],
    nf: wp.array[int],
    nl: wp.array[int],
    njmax: int,
    efc_type: wp.array2d[int],
    efc_id: wp.array2d[int],
    efc_force: wp.array2d[float],
    sensordata: wp.array2d[float],
):
    world, place = wp.tid()
    sensor = sensors[place]
    kind = TENDON_ROW if sensor_type[sensor] == TENDON_FRC else JOINT_ROW
    # Rows stand in the order equality, friction, limits; those beyond njmax were not made.
    first = ne[world] + nf[world]
    end = wp.min(first + nl[world], njmax)
    value = float(0.0)  # noqa: UP018 (Warp: a variable that changes)
    found = bool(False)  # noqa: UP018 (Warp: a variable that changes in a loop)
    for row in range(first, end):
        # Where both limits hold, the first row counts, which is the lower limit's.
        if (
            not found
            and efc_type[world, row] == kind
            and efc_id[world, row] == sensor_objid[sensor]
        ):
            value = efc_force[world, row]
            found = True
    sensordata[world, sensor_adr[sensor]] = _cut(
        value, sensor_cutoff[sensor], sensor_datatype[sensor]
    )
