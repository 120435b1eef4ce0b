"""Launches the substeps of a world, with the sensors that are asked for."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Literal, get_args

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import substep, upstream
from ksim_rl.physics.actuators.adhesion import miscounts_contacts, transmissions_of_contacts
from ksim_rl.physics.collision.collisions import collisions
from ksim_rl.physics.fixed_geoms import placing_of_fixed_geoms
from ksim_rl.physics.integration.integrators import integrator
from ksim_rl.physics.newton import solver as newton
from ksim_rl.physics.refresh import Refresh
from ksim_rl.physics.rows.constraint_rows import constraint_rows
from ksim_rl.physics.rows.contact_lists import ContactLists
from ksim_rl.physics.rows.idle_ties import stilling_of_ties
from ksim_rl.physics.rows.second_limits import adding_of_second_limits
from ksim_rl.physics.rows.tie_counts import counting_of_ties
from ksim_rl.physics.rows.tie_weights import BODY_EQUALITIES, weighing_of_ties
from ksim_rl.physics.sensors.contact_sensors import ContactReadings
from ksim_rl.physics.sensors.limit_sensors import LimitSensors
from ksim_rl.physics.sensors.sensor_mending import mend_sensors
from ksim_rl.physics.smooth.stages import calls_back, integration, smooth_dynamics
from ksim_rl.physics.substep_plan import SubstepPlan
from ksim_rl.physics.views import FORCES_OF_BODIES

Sensors = Literal["none", "contacts", "kept", "all"]
"""Which sensors a substep computes: none, contact sensors, the ones that a refresh afterwards keeps, or all."""


class Substeps:
    """Shallow variants of one Warp model, so that a stage is left out without touching the model itself.

    The variants share all arrays with `warp_model`. Build them once its arrays are in their final place. The `plan`
    says which stages are ours. Our rows come with `contact_lists`, from which contact sensors are read; our
    integration keeps a `record` of overflow. Work that can run in parallel with the rest of a substep does so on the
    stream `side_stream`.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        warp_model: mjw.Model,
        warp_data_E: mjw.Data,
        *,
        plan: SubstepPlan,
        side_stream: wp.Stream | None = None,
        mask: wp.array | None = None,
        record: Mapping[str, wp.array] | None = None,
        expanded: Collection[str] = (),
    ) -> None:
        self.warp_model = warp_model
        self.warp_data_E = warp_data_E
        # A delayed sensor samples at every substep.
        self._always_senses = bool(np.any(mj_model.sensor_history > 0))
        self._place_fixed_geoms = placing_of_fixed_geoms(warp_model, warp_data_E, expanded)
        self._ties_bodies = bool(np.isin(mj_model.eq_type, BODY_EQUALITIES).any())
        limits = LimitSensors(mj_model, warp_model, warp_data_E)
        if plan.dynamics is None:
            dynamics = smooth_dynamics(warp_model, warp_data_E, mask=mask)
        else:
            dynamics = None
        self._refresh = Refresh(
            mj_model,
            warp_model,
            warp_data_E,
            dynamics,
            limits,
            place_fixed_geoms=self._place_fixed_geoms,
        )
        everything = upstream.without_limit_sensors(warp_model)
        self._models: dict[Sensors, mjw.Model] = dict.fromkeys(get_args(Sensors), everything)
        if not self._always_senses:
            self._models["none"] = upstream.without_sensors(warp_model)
            # Each variant leaves out the kernels whose results are not read after that substep.
            self._models["contacts"] = upstream.with_contact_sensors_only(warp_model)
            self._models["kept"] = upstream.without_limit_sensors(self._refresh.kept_by_substep)
        if not self._refresh.needs_cameras:
            # Cameras are placed on refresh where something reads them, see `Refresh`.
            self._alter(ncam=0, nlight=0)
        if plan.solver is None:
            # A world without constraints reaches that acceleration in one step.
            self._alter(opt=dataclasses.replace(warp_model.opt, run_qacc_smooth=False))
            solve = newton.solver(self._models["all"], warp_data_E)
        else:
            solve = partial(_solve_as_they_do, warp_model, warp_data_E)
        self.contact_lists: ContactLists | None = None
        make_rows = contacts = collide = None
        if plan.rows is None and plan.solver is None:
            self.contact_lists = ContactLists(warp_model, warp_data_E)
            make_rows = constraint_rows(warp_model, warp_data_E, self.contact_lists)
            contacts = ContactReadings(mj_model, warp_model, warp_data_E, self.contact_lists)
            if plan.broad_phase is None:
                collide = collisions(warp_model, warp_data_E, self.contact_lists)
        # Sensors that our kernels read, and those that are mended, must not be computed again by MuJoCo Warp's.
        ours = [] if contacts is None else contacts.sensors
        mended = mend_sensors(
            mj_model, warp_model, warp_data_E, read=ours, lists=self.contact_lists
        )
        if ours or mended:
            self._models = {
                which: upstream.without(ours + mended, m) for which, m in self._models.items()
            }
        self._reads_contacts = bool(mended)
        if warp_model.opt.run_rne_postconstraint or self._models["kept"].sensor_rne_postconstraint:
            # A sensor is left that needs forces of all bodies: our own kernels read accelerometers without them.
            self._refresh.on_demand |= FORCES_OF_BODIES
        # Corrections of rows are made after MuJoCo Warp's; our own rows need none.
        mend = _mending(mj_model, warp_model, warp_data_E, expanded)
        self._integrates = plan.integration is None
        if self._integrates:
            integrate = partial(_integrate, integration(warp_model, warp_data_E, record=record))
        else:
            integrate = integrator(mj_model, warp_model, warp_data_E, mend=mend)
        self.stages = substep.Stages(
            solve=solve,
            integrate=integrate,
            dynamics=dynamics,
            make_rows=make_rows,
            collide=collide,
            contacts=contacts,
            limits=limits,
            mend=mend,
            side_stream=side_stream,
        )

    @property
    def refreshed_on_demand(self) -> set[str]:
        """The names of arrays that `refresh` computes because something reads them, to add to."""
        return self._refresh.on_demand

    def _alter(self, **fields: wp.array | mjw.Option) -> None:
        """Change fields of the models of substeps, which share all else with `warp_model`."""
        self._models = {
            which: dataclasses.replace(m, **fields) for which, m in self._models.items()
        }

    def advance(self, *, sensors: Sensors, is_last: bool = True) -> None:
        """Launch one physics step. Sensors never change the state that it reaches; after the last, all may be read."""
        # First, since collisions and kinematics read where these geoms are.
        self.place_fixed_geoms()
        m = self._models[sensors]
        # It may have been switched on since these variants were made.
        m.opt.run_rne_postconstraint = self.warp_model.opt.run_rne_postconstraint
        if sensors in ("kept", "all"):
            m.sensor_rne_postconstraint |= self.refreshed_on_demand >= FORCES_OF_BODIES
        stages = self.stages
        # Callbacks are set at any time, and stand between the stages of the kernel.
        if calls_back(self.warp_model):
            stages = dataclasses.replace(stages, dynamics=None)
        if stages.dynamics is None:
            # Our kernel has computed velocities before the rows; MuJoCo Warp's step has not.
            self._prepare_ties()
        else:
            dynamics = partial(
                stages.dynamics,
                is_read=self._is_read(m, sensors, is_last=is_last),
                empties_pool=stages.collide is not None and m.opt.run_collision_detection,
            )
            stages = dataclasses.replace(stages, dynamics=dynamics)
        # Delayed sensors have to sample at every substep, whichever sensors were asked for.
        always = self._always_senses
        substep.run(
            stages,
            m,
            self.warp_data_E,
            sensors=always or sensors != "none",
            accelerometers=always or sensors != "contacts",
        )

    def _prepare_ties(self) -> None:
        """Launch body velocities, which rows of connect and weld read before MuJoCo Warp's step computes them."""
        if self._ties_bodies:
            mjw.kinematics(self.warp_model, self.warp_data_E)
            mjw.com_pos(self.warp_model, self.warp_data_E)
            mjw.com_vel(self.warp_model, self.warp_data_E)

    def _is_read(self, warp_model: mjw.Model, sensors: Sensors, *, is_last: bool) -> bool:
        """Whether anything but our own kernels reads the arrays that the dynamics of this substep write."""
        # Where a stage is MuJoCo Warp's, it reads every array.
        if self.stages.make_rows is None or not self._integrates:
            return True
        if self._always_senses or warp_model.opt.run_rne_postconstraint:
            return True
        if sensors == "contacts":
            # Contact sensors that follow MuJoCo Warp's may be of sites, and of velocities.
            return self._reads_contacts or warp_model.sensor_contact_acc_adr.size > 0
        # Otherwise sensors, or readers of views after the last substep, do.
        return is_last or sensors != "none"

    def place_fixed_geoms(self) -> None:
        """Launch the places of the geoms that are fixed to the world, where fields that move them differ."""
        if self._place_fixed_geoms is not None:
            self._place_fixed_geoms()

    def refresh(self, *, masked: bool = False) -> None:
        """Launch position- and velocity-stage quantities from the present qpos and qvel.

        No collision pass: contacts, forces and the sensors that read them stay as the last substep left them. `masked`
        leaves worlds alone that are not in the mask, where that takes less time.
        """
        self._refresh.launch(masked=masked)


def _integrate(launch: Callable[[], None], substep_warp_model: mjw.Model) -> None:
    """Launch our kernel of the integration, which needs no variant of the model."""
    launch()


def _solve_as_they_do(
    warp_model: mjw.Model, warp_data_E: mjw.Data, *, orders: bool = True, solves: bool = True
) -> None:
    """Launch MuJoCo Warp's own solver, which has no order of worlds."""
    if solves:
        upstream.solve_as_they_do(warp_model, warp_data_E)


def _mending(
    mj_model: mujoco.MjModel,
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    expanded: Collection[str],
) -> Callable[[], None] | None:
    """Return a launcher of the corrections that MuJoCo Warp's solver needs before it; None where all is right."""
    # The first ones change rows of MuJoCo Warp's; the last one appends rows.
    of_rows = (
        counting_of_ties(mj_model, warp_data_E),
        weighing_of_ties(mj_model, warp_model, warp_data_E),
        stilling_of_ties(mj_model, warp_model, warp_data_E),
        adding_of_second_limits(warp_model, warp_data_E, expanded),
    )
    launches = [launch for launch in of_rows if launch is not None]
    if miscounts_contacts(warp_model):
        launches.append(transmissions_of_contacts(warp_model, warp_data_E))
    if upstream.may_sleep(warp_model.opt):
        # Its solver leaves forces of worlds without rows as they were, which at first is whatever the memory held.
        launches.append(warp_data_E.cqfrc_constraint.zero_)
    if not launches:
        return None

    def mend() -> None:
        for launch in launches:
            launch()

    return mend
