"""This module launches the substeps of a world with the sensors that are wanted, and the refresh of what derives."""

import dataclasses
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.collision.collisions import collisions
from ksim_rl.physics.contact_sensors import ContactReadings
from ksim_rl.physics.fixed_geoms import placing_of_fixed_geoms
from ksim_rl.physics.mended_step import check_mendable, mended_step
from ksim_rl.physics.newton import solver as newton
from ksim_rl.physics.rows.constraint_rows import constraint_rows
from ksim_rl.physics.rows.contact_lists import ContactLists
from ksim_rl.physics.rows.second_limits import adding_of_second_limits
from ksim_rl.physics.rows.tie_weights import BODY_EQUALITIES, weighing_of_ties
from ksim_rl.physics.sensor_mending import mend_sensors
from ksim_rl.physics.smooth.stages import calls_back, integration, smooth_dynamics
from ksim_rl.physics.views import CAMERAS_AND_LIGHTS, FORCES_OF_BODIES, SUBTREE_VELOCITIES

# These read the contacts of the last substep's collision pass, which a reset empties.
COLLISION_SENSORS = (
    mujoco.mjtSensor.mjSENS_GEOMDIST,
    mujoco.mjtSensor.mjSENS_GEOMNORMAL,
    mujoco.mjtSensor.mjSENS_GEOMFROMTO,
)
TRANSMISSION_SENSORS = (mujoco.mjtSensor.mjSENS_ACTUATORPOS, mujoco.mjtSensor.mjSENS_ACTUATORVEL)
Sensors = Literal["none", "contacts", "kept", "all"]
"""Which sensors a substep computes: none, those of contacts, those that a refresh afterwards keeps, or all."""


class Substeps:
    """Shallow variants of one Warp model, so that a stage is left out without touching the model itself.

    The variants share all arrays with `warp_model`. Build them once its arrays are in their final place. With
    `one_kernel_solver`, `newton` solves, which must suit the model, instead of MuJoCo Warp's own solver. Then, with
    `one_kernel_dynamics`, which must suit it too, one kernel precedes the constraints. Then, with `one_kernel_rows`,
    one makes their rows, and `contact_lists` besides, from which contact sensors are read, with `own_broad_phase` one
    finds contacts, and with `one_kernel_integration` one kernel integrates and keeps a `record` of overflow. What can
    run beside the rest of a substep does so on the stream `aside`.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        warp_model: mjw.Model,
        warp_data_E: mjw.Data,
        *,
        one_kernel_solver: bool = False,
        one_kernel_dynamics: bool = False,
        one_kernel_rows: bool = False,
        own_broad_phase: bool = False,
        one_kernel_integration: bool = False,
        aside: wp.Stream | None = None,
        mask: wp.array | None = None,
        record: Mapping[str, wp.array] | None = None,
        expanded: Collection[str] = (),
    ) -> None:
        self.warp_model, self.warp_data_E, self._aside = warp_model, warp_data_E, aside
        sensor_type = mj_model.sensor_type
        has_history = np.any(mj_model.sensor_history > 0, axis=-1)
        # A delayed sensor samples at every substep.
        self._always_senses = bool(has_history.any())
        self._refresh_warp_model, keeping = upstream.sensors_by_refresh(
            warp_model, skip=has_history | np.isin(sensor_type, COLLISION_SENSORS), sensor_type=sensor_type
        )
        self._models: dict[Sensors, mjw.Model] = dict.fromkeys(get_args(Sensors), warp_model)
        if not self._always_senses:
            self._models |= {"none": upstream.without_sensors(warp_model), "kept": keeping}
            self._models["contacts"] = upstream.with_contact_sensors_only(warp_model)
        self._solve: Callable[..., None] | None = None
        if one_kernel_solver:
            # A world without constraints reaches that acceleration in one step.
            self._alter(opt=dataclasses.replace(warp_model.opt, run_qacc_smooth=False))
            self._solve = newton.solver(self._models["all"], warp_data_E)
        self._dynamics = self._integrate = None
        if one_kernel_dynamics:
            self._dynamics = smooth_dynamics(warp_model, warp_data_E, mask=mask)
            self._refresh_warp_model.sensor_subtree_vel = False
        self.contact_lists: ContactLists | None = None
        self._make_rows: Callable[[], None] | None = None
        self._contacts: ContactReadings | None = None
        self._collide: Callable[[], None] | None = None
        if one_kernel_rows and one_kernel_solver:
            self.contact_lists = ContactLists(warp_model, warp_data_E)
            self._make_rows = constraint_rows(warp_model, warp_data_E, self.contact_lists)
            self._contacts = ContactReadings(mj_model, warp_model, warp_data_E, self.contact_lists)
            if own_broad_phase:
                self._collide = collisions(warp_model, warp_data_E, self.contact_lists)
        ours = [] if self._contacts is None else self._contacts.sensors
        mended = mend_sensors(mj_model, warp_model, warp_data_E, read=ours, lists=self.contact_lists)
        if ours or mended:
            self._models = {which: upstream.without(ours + mended, m) for which, m in self._models.items()}
        # Those may be of sites, and of velocities.
        self._reads_contacts = bool(mended)
        self._place_fixed_geoms = placing_of_fixed_geoms(warp_model, warp_data_E, expanded)
        if one_kernel_integration:
            self._integrate = integration(warp_model, warp_data_E, record=record)
        self._needs_transmission = bool(np.isin(sensor_type, TRANSMISSION_SENSORS).any())
        mends = [
            weighing_of_ties(mj_model, warp_model, warp_data_E),
            adding_of_second_limits(warp_model, warp_data_E, expanded),
        ]
        self._row_mends = [mend for mend in mends if mend is not None]
        self._limits_warp_model: mjw.Model | None = None
        if self._row_mends and self._solve is None:
            check_mendable(warp_model)
            if warp_model.sensor_limitpos_adr.size:
                self._limits_warp_model = upstream.with_limit_positions_only(warp_model)
        self._ties_bodies = bool(np.isin(mj_model.eq_type, BODY_EQUALITIES).any())
        self.refreshed_on_demand: set[str] = set()
        if (sensor_type == mujoco.mjtSensor.mjSENS_TENDONVEL).any():
            self.refreshed_on_demand.add("ten_velocity")
        if warp_model.sensor_subtree_vel:
            self.refreshed_on_demand |= SUBTREE_VELOCITIES
        if warp_model.opt.run_rne_postconstraint or self._models["kept"].sensor_rne_postconstraint:
            self.refreshed_on_demand |= FORCES_OF_BODIES
        if mujoco.mjtObj.mjOBJ_CAMERA in (*mj_model.sensor_objtype, *mj_model.sensor_reftype):
            self.refreshed_on_demand |= CAMERAS_AND_LIGHTS
        else:
            self._alter(ncam=0, nlight=0)

    def _alter(self, **fields: Any) -> None:
        """Change fields of the models of substeps, which share all else with `warp_model`."""
        self._models = {which: dataclasses.replace(m, **fields) for which, m in self._models.items()}

    def advance(self, *, sensors: Sensors, is_last: bool = True) -> None:
        """Launch one physics step. Sensors never change the state that it reaches; after the last, all may be read."""
        if self._place_fixed_geoms is not None:
            self._place_fixed_geoms()
        # Callbacks are set at any time, and stand between the stages of the kernel.
        dynamics = None if calls_back(self.warp_model) else self._dynamics
        if self._ties_bodies and dynamics is None:
            # The rows of connect and weld read body velocities before a step computes them.
            mjw.kinematics(self.warp_model, self.warp_data_E)
            mjw.com_pos(self.warp_model, self.warp_data_E)
            mjw.com_vel(self.warp_model, self.warp_data_E)
        m = self._models[sensors]
        if self._solve is None:
            mended_step(m, self.warp_data_E, self._row_mends, self._limits_warp_model)
            return
        m.opt.run_rne_postconstraint = self.warp_model.opt.run_rne_postconstraint
        if sensors in ("kept", "all"):
            m.sensor_rne_postconstraint |= self.refreshed_on_demand >= FORCES_OF_BODIES
        left = self._reads_contacts or m.sensor_contact_acc_adr.size > 0
        is_read = left if sensors == "contacts" else is_last or sensors != "none"
        is_read |= self._always_senses or m.opt.run_rne_postconstraint
        is_read |= self._make_rows is None or self._integrate is None
        if dynamics is not None:
            empties_pool = self._collide is not None and m.opt.run_collision_detection
            dynamics = partial(dynamics, is_read=is_read, empties_pool=empties_pool)
        stages = self._solve, dynamics, self._make_rows, self._contacts, self._integrate
        always = self._always_senses
        wanted = {"sensors": always or sensors != "none", "accelerometers": always or sensors != "contacts"}
        mends = self._row_mends
        newton.step(m, self.warp_data_E, *stages, self._aside, self._collide, row_mends=mends, **wanted)

    def refresh(self, *, masked: bool = False) -> None:
        """Launch what recomputes position- and velocity-stage quantities from the present qpos and qvel.

        No collision pass: contacts, forces and the sensors that read them stay as the last substep left them. `masked`
        leaves worlds alone that are not in the mask, where that takes less time.
        """
        m, d, needed = self._refresh_warp_model, self.warp_data_E, self.refreshed_on_demand
        sums_momenta = bool(needed & SUBTREE_VELOCITIES)
        if self._place_fixed_geoms is not None:
            self._place_fixed_geoms()
        if self._dynamics is None:
            mjw.kinematics(m, d)
            mjw.com_pos(m, d)
            mjw.flex(m, d)
            mjw.tendon(m, d)
            mjw.com_vel(m, d)
        else:
            self._dynamics(forces_too=False, sums_momenta=sums_momenta, masked=masked)
        if needed & CAMERAS_AND_LIGHTS:
            mjw.camlight(m, d)
        if "M" in needed:
            mjw.crb(m, d)
            upstream.tendon_armature(m, d)
        if "qfrc_bias" in needed:
            mjw.rne(m, d)
            upstream.tendon_bias(m, d, d.qfrc_bias)
        if "ten_velocity" in needed:
            pattern = (m.ten_J_rownnz, m.ten_J_rowadr, m.ten_J_colind)
            shared = [array.reshape((1, -1)) for array in pattern]
            self._launch_product(shared, d.ten_J, d.ten_velocity)
        if self._needs_transmission:
            mjw.transmission(m, d)
            pattern = (d.moment_rownnz, d.moment_rowadr, d.moment_colind)
            self._launch_product(pattern, d.actuator_moment, d.actuator_velocity)
        # A model with sensors of them computes them with these.
        if sums_momenta and self._dynamics is None and not m.sensor_subtree_vel:
            mjw.subtree_vel(m, d)
        mjw.sensor_pos(m, d)
        mjw.sensor_vel(m, d)

    def _launch_product(self, pattern: Sequence[wp.array], matrix: wp.array, velocity: wp.array) -> None:
        inputs = [*pattern, matrix, self.warp_data_E.qvel]
        wp.launch(kernels.sparse_velocity, dim=velocity.shape, inputs=inputs, outputs=[velocity])
