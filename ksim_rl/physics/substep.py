"""Runs the stages of one substep, ours or MuJoCo Warp's, in the order of MuJoCo's forward dynamics."""

import dataclasses
from collections.abc import Callable
from functools import partial

import mujoco_warp as mjw
import warp as wp

from ksim_rl.device.streams import beside
from ksim_rl.physics import upstream
from ksim_rl.physics.native import FEW_WORLDS
from ksim_rl.physics.sensors.contact_sensors import ContactReadings
from ksim_rl.physics.sensors.limit_sensors import LimitSensors


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stages:
    """The launchers of the stages of a substep.

    Attributes:
        solve: accelerations and forces from the constraint rows; see `newton.solver`.
        integrate: the state at the end of the substep, from the model that the substep takes.
        dynamics: smooth dynamics as one kernel; None for MuJoCo Warp's kernels.
        make_rows: the constraint rows as one kernel, which needs `dynamics`; None for MuJoCo Warp's kernels.
        collide: a collision pass other than MuJoCo Warp's.
        contacts: reads contact sensors and accelerometers from lists of contacts; None for MuJoCo Warp's kernels.
        limits: reads the sensors of limits.
        mend: mends MuJoCo Warp's constraint rows and transmissions, where these are wrong.
        side_stream: a side stream for work that can run in parallel with the rest.
    """

    solve: Callable[..., None]
    integrate: Callable[[mjw.Model], None]
    dynamics: Callable[..., None] | None = None
    make_rows: Callable[[], None] | None = None
    collide: Callable[[], None] | None = None
    contacts: ContactReadings | None = None
    limits: LimitSensors | None = None
    mend: Callable[[], None] | None = None
    side_stream: wp.Stream | None = None


def run(
    stages: Stages,
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    sensors: bool,
    accelerometers: bool = True,
) -> None:
    """Launch a substep. Sensors, computed or not, never change the state that is reached.

    On the side stream, the solver orders the worlds, by the last substep, and dynamics of few worlds go on in
    parallel with collisions; then it solves in parallel with some sensors. `accelerometers` are left out where they are
    not wanted, if `contacts` reads them.
    """
    m = warp_model
    d = warp_data_E
    side_stream = stages.side_stream
    # Stages of MuJoCo Warp, and callbacks, may touch any array, so that nothing runs in parallel with them.
    if stages.dynamics is None or m.callback.sensor:
        side_stream = None
    if stages.dynamics is None:
        _launch_their_dynamics(stages, m, d)
    else:
        _launch_our_dynamics(stages, stages.dynamics, m, d, side_stream)
    # Sensors of positions and velocities do not read the solution, so that both run in parallel.
    with beside(side_stream if sensors else None, partial(_act_and_solve, stages, m, d)):
        if sensors:
            _read_state(stages, m, d)
    _read_forces(stages, m, d, sensors=sensors, accelerometers=accelerometers)
    stages.integrate(m)


def _launch_their_dynamics(stages: Stages, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    # The same order as in MuJoCo Warp's own `forward`.
    upstream.wake_trees(warp_model, warp_data_E)
    mjw.fwd_position(warp_model, warp_data_E, factorize=False)
    # Before velocities and forces, since rows and transmissions must be right for these.
    if stages.mend is not None:
        stages.mend()
    mjw.fwd_velocity(warp_model, warp_data_E)
    if warp_model.opt.disableflags & mjw.DisableBit.ACTUATION:
        # C does not compute it then.
        warp_data_E.actuator_velocity.zero_()
    if stages.contacts is not None:
        stages.contacts.list()


def _launch_our_dynamics(
    stages: Stages,
    dynamics: Callable[..., None],
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    side_stream: wp.Stream | None,
) -> None:
    # Where dynamics alone fill a GPU, placing bodies twice, for collisions first, takes longer than it saves.
    in_parallel = side_stream is not None and warp_data_E.nworld <= FEW_WORLDS
    # While collisions run, the rest of the dynamics goes on without placing geoms a second time.
    if in_parallel:
        rest = [partial(dynamics, places_geoms=False)]
    else:
        rest = []
    # The worlds are ordered while collisions run, since their order follows from the last substep.
    with beside(side_stream, partial(stages.solve, solves=False), *rest):
        dynamics(goes_on=not in_parallel)
        if warp_model.opt.run_collision_detection:
            if stages.collide is not None:
                stages.collide()
            else:
                mjw.collision(warp_model, warp_data_E)
    # MuJoCo Warp's rows are corrected; ours need no corrections.
    if stages.make_rows is None:
        mjw.make_constraint(warp_model, warp_data_E)
        if stages.mend is not None:
            stages.mend()
    else:
        stages.make_rows()


def _act_and_solve(stages: Stages, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    is_theirs = stages.dynamics is None
    if is_theirs:
        # Callbacks of controls come before actuation, as in MuJoCo.
        if (
            warp_model.callback.control
            and not warp_model.opt.disableflags & mjw.DisableBit.ACTUATION
        ):
            warp_model.callback.control(warp_model, warp_data_E)
        mjw.fwd_actuation(warp_model, warp_data_E)
        mjw.fwd_acceleration(warp_model, warp_data_E, factorize=True)
    stages.solve(orders=is_theirs)


def _read_state(stages: Stages, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
    """Launch the sensors that positions and velocities decide."""
    # Our kernel of the dynamics leaves cameras and lights out.
    if stages.dynamics is not None:
        mjw.camlight(warp_model, warp_data_E)
    # Sensors that compute nothing in this substep read zero.
    warp_data_E.sensordata.zero_()
    if stages.limits is not None:
        # Before the others, among which MuJoCo Warp delays those with a history.
        stages.limits.read_state()
    mjw.sensor_pos(warp_model, warp_data_E)
    upstream.energy_of_position(warp_model, warp_data_E)
    mjw.sensor_vel(warp_model, warp_data_E)
    upstream.energy_of_velocity(warp_model, warp_data_E)


def _read_forces(
    stages: Stages,
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    sensors: bool,
    accelerometers: bool,
) -> None:
    """Launch the sensors that accelerations and forces decide, and those forces of bodies that something reads."""
    # Accelerations and forces of all bodies are computed only where something reads them.
    runs_rne = warp_model.opt.run_rne_postconstraint or (
        sensors and warp_model.sensor_rne_postconstraint
    )
    if runs_rne and stages.contacts is not None:
        stages.contacts.rne_postconstraint(warp_model)
    elif runs_rne:
        mjw.rne_postconstraint(warp_model, warp_data_E)
    if not sensors:
        return
    if stages.contacts is not None:
        stages.contacts.read_sensors(accelerometers=accelerometers)
    if stages.limits is not None:
        stages.limits.read_forces()
    mjw.sensor_acc(warp_model, warp_data_E, skip_rne_postconstraint=True)
