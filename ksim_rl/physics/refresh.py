"""Launches the refresh of a world: quantities that follow from the present state, without a collision pass."""

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.actuators.adhesion import transmissions_of_refresh
from ksim_rl.physics.sensors.limit_sensors import LimitSensors
from ksim_rl.physics.views import CAMERAS_AND_LIGHTS, SUBTREE_VELOCITIES

# These read the contacts of the last substep's collision pass, which a reset empties.
COLLISION_SENSORS = (
    mujoco.mjtSensor.mjSENS_GEOMDIST,
    mujoco.mjtSensor.mjSENS_GEOMNORMAL,
    mujoco.mjtSensor.mjSENS_GEOMFROMTO,
)
TRANSMISSION_SENSORS = (mujoco.mjtSensor.mjSENS_ACTUATORPOS, mujoco.mjtSensor.mjSENS_ACTUATORVEL)
TENDON_VELOCITY = "ten_velocity"


class Refresh:
    """Recomputes position- and velocity-stage quantities and sensors, with arrays in their final place.

    Args:
        dynamics: launches our kernel of the smooth dynamics; None takes MuJoCo Warp's kernels.
        limits: reads the sensors of limits.
        place_fixed_geoms: launches the places of geoms that are fixed to the world; None where they are fixed.

    Attributes:
        kept_by_substep: a model on the same arrays with those sensors alone that no refresh computes.
        on_demand: the names of arrays that are computed because something reads them.
        needs_cameras: whether a sensor reads where cameras are.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        warp_model: mjw.Model,
        warp_data_E: mjw.Data,
        dynamics: Callable[..., None] | None,
        limits: LimitSensors,
        *,
        place_fixed_geoms: Callable[[], None] | None,
    ) -> None:
        self._warp_data_E = warp_data_E
        self._dynamics = dynamics
        self._limits = limits
        self._place_fixed_geoms = place_fixed_geoms
        sensor_type = mj_model.sensor_type
        # A delayed sensor samples at substeps: no refresh may change it.
        has_history = np.any(mj_model.sensor_history > 0, axis=-1)
        self._warp_model, self.kept_by_substep = upstream.sensors_by_refresh(
            warp_model,
            skip=has_history | np.isin(sensor_type, COLLISION_SENSORS),
            sensor_type=sensor_type,
        )
        if dynamics is not None:
            # It sums the momenta itself.
            self._warp_model.sensor_subtree_vel = False
        # A model with sensors of them computes them with these, unless it has none computed.
        reads_sensors = not int(mj_model.opt.disableflags) & mujoco.mjtDisableBit.mjDSBL_SENSOR
        self._sensors_sum_momenta = reads_sensors and bool(self._warp_model.sensor_subtree_vel)
        # The lengths and moments of actuators are computed only where a sensor reads them.
        self._transmit = self._transmissions(warp_model, sensor_type)
        self._actuators_act = (
            not int(mj_model.opt.disableflags) & mujoco.mjtDisableBit.mjDSBL_ACTUATION
        )
        objects = (*mj_model.sensor_objtype, *mj_model.sensor_reftype)
        self.needs_cameras = mujoco.mjtObj.mjOBJ_CAMERA in objects
        self.on_demand = self._read_by_sensors(warp_model, sensor_type)

    def _transmissions(
        self, warp_model: mjw.Model, sensor_type: np.ndarray
    ) -> Callable[[], None] | None:
        if not np.isin(sensor_type, TRANSMISSION_SENSORS).any():
            return None
        return transmissions_of_refresh(warp_model, self._warp_data_E)

    def _read_by_sensors(self, warp_model: mjw.Model, sensor_type: np.ndarray) -> set[str]:
        """Return the names of the arrays that sensors need, though nothing else may."""
        names: set[str] = set()
        reads_tendons = (sensor_type == mujoco.mjtSensor.mjSENS_TENDONVEL).any()
        if reads_tendons or self._limits.reads_tendons:
            names.add(TENDON_VELOCITY)
        if (sensor_type == mujoco.mjtSensor.mjSENS_E_KINETIC).any():
            names.add("M")
        if warp_model.sensor_subtree_vel:
            names |= SUBTREE_VELOCITIES
        if self.needs_cameras:
            names |= CAMERAS_AND_LIGHTS
        return names

    def launch(self, *, masked: bool = False) -> None:
        """Launch it; `masked` leaves worlds alone that are not in the mask, where that takes less time."""
        m = self._warp_model
        d = self._warp_data_E
        # First, so that the launches below read their present places.
        if self._place_fixed_geoms is not None:
            self._place_fixed_geoms()
        # Momenta of subtrees may be read by terms, without any sensor.
        sums_momenta = bool(self.on_demand & SUBTREE_VELOCITIES)
        if self._dynamics is None:
            mjw.kinematics(m, d)
            mjw.com_pos(m, d)
            mjw.flex(m, d)
            mjw.tendon(m, d)
            mjw.com_vel(m, d)
        else:
            self._dynamics(forces_too=False, sums_momenta=sums_momenta, masked=masked)
        # After the kinematics, on which all of these build.
        self._launch_on_demand()
        if self._transmit is not None:
            self._transmit()
            self._launch_actuator_velocities()
        # Our kernel has summed them; MuJoCo Warp's sensors sum them by themselves.
        if sums_momenta and self._dynamics is None and not self._sensors_sum_momenta:
            mjw.subtree_vel(m, d)
        self._limits.read_state(in_refresh=True)
        # Sensors come last, when all that they read is present.
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)

    def _launch_on_demand(self) -> None:
        m = self._warp_model
        d = self._warp_data_E
        if self.on_demand & CAMERAS_AND_LIGHTS:
            mjw.camlight(m, d)
        # The inertia matrix is a position-stage quantity: sensors of kinetic energy read it.
        if "M" in self.on_demand:
            mjw.crb(m, d)
            upstream.tendon_armature(m, d)
        if "qfrc_bias" in self.on_demand:
            upstream.bias_forces(m, d)
        if TENDON_VELOCITY in self.on_demand:
            # All worlds have one pattern; the kernel expects rows of patterns.
            pattern = (m.ten_J_rownnz, m.ten_J_rowadr, m.ten_J_colind)
            shared = [array.reshape((1, -1)) for array in pattern]
            kernels.multiply_by_qvel(shared, d.ten_J, d.qvel, d.ten_velocity)

    def _launch_actuator_velocities(self) -> None:
        d = self._warp_data_E
        if self._actuators_act:
            pattern = (d.moment_rownnz, d.moment_rowadr, d.moment_colind)
            kernels.multiply_by_qvel(pattern, d.actuator_moment, d.qvel, d.actuator_velocity)
        else:
            # As in C, which does not compute them then.
            d.actuator_velocity.zero_()
