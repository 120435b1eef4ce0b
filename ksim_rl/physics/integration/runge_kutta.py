"""Launches MuJoCo Warp's Runge-Kutta, and mends the readings that its stages leave wrong."""

import dataclasses
from collections.abc import Callable

import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.actuators.disabled_actuators import SWITCHED_OFF

# When the stages after the first are, in timesteps from the beginning of the step.
STAGE_TIMES = (0.5, 0.5, 1.0)
# Where trees may sleep, MuJoCo Warp computes these once more, of the state that it reached.
READINGS = ("actuator_velocity", "qfrc_passive")


def hook_after_rows(warp_model: mjw.Model) -> str:
    """Return the callback that MuJoCo Warp calls between its rows and its solver.

    It calls the second unless actuation is disabled: then a model takes its place whose actuators do nothing.
    """
    flags = int(warp_model.opt.disableflags)
    bits = mjw.DisableBit
    # Passive forces are called back only if there are springs or dampers.
    if flags & bits.SPRING and flags & bits.DAMPER:
        return "control"
    return "passive"


def mended_runge_kutta(
    warp_model: mjw.Model, warp_data_E: mjw.Data, mend: Callable[[], None] | None
) -> Callable[[mjw.Model], None]:
    """Return a launcher of `mjw.rungekutta4`, and `mend` after the rows of each of its stages.

    Rows that tie bodies are made a second time, when the velocities belong to the stage and not to the one before.
    It leaves the readings and the `act_dot` of the last stage, as C does, and not the mean of all four rates. Delayed
    controls are read at the stage's own time, and exact filters reach the stage by their rate, as in C.
    """
    d = warp_data_E
    # Whether actuation is on: a disabled one calls no callback of controls.
    acts = not int(warp_model.opt.disableflags) & mjw.DisableBit.ACTUATION
    hooks: dict[str, list[Callable[[], None]]] = {}
    mends = [] if mend is None else [mend]
    if warp_model.eq_connect_adr.size + warp_model.eq_wld_adr.size:
        # Rows of connect and weld read body velocities, which at the time of the hook belong to the stage.
        mends.insert(0, lambda: mjw.make_constraint(warp_model, warp_data_E))
    hook = hook_after_rows(warp_model)
    if mends:
        hooks.setdefault(hook, []).extend(mends)
    readings = _LastReadings(warp_data_E)
    may_sleep = upstream.may_sleep(warp_model.opt)
    if may_sleep:
        hooks.setdefault(hook, []).append(readings.take)
    keeps_rate = acts and warp_model.na > 0
    last_rate_E = wp.zeros_like(d.act_dot)
    if keeps_rate:
        # Each stage overwrites the copy, so that the last one's is left.
        hooks.setdefault("act_dyn", []).append(lambda: wp.copy(last_rate_E, d.act_dot))
    filters = _ExactFilters(warp_model, warp_data_E)
    if acts and filters.exist:
        hooks.setdefault("control", []).append(filters.rate)
    clock = _StageClock(warp_model, warp_data_E)
    # Without actuators nothing calls the second of these, and nothing is delayed that a stage reads.
    if acts and warp_model.nactuator > 0 and warp_model.nhistory > 0:
        hooks.setdefault("control", []).append(clock.advance)
        hooks.setdefault("act_dyn", []).append(clock.put_back)

    # With actuation off, the control hook is called only if actuators seem to act.
    if hook == "control" and not acts:
        changes = _idle_actuators(warp_model)
    else:
        changes = {}

    def launch(substep_warp_model: mjw.Model) -> None:
        clock.start()
        filters.start()
        readings.start()
        # Hooks are set for this call alone, so that the program's own callbacks stay visible.
        callback = _with_hooks(substep_warp_model.callback, hooks)
        mjw.rungekutta4(dataclasses.replace(substep_warp_model, callback=callback, **changes), d)
        if keeps_rate:
            wp.copy(d.act_dot, last_rate_E)
        if may_sleep:
            readings.put_back()
        if not acts:
            # C does not compute it then.
            d.actuator_velocity.zero_()

    return launch


def _idle_actuators(warp_model: mjw.Model) -> dict[str, wp.array | mjw.Option]:
    """Return the fields of a model whose actuators may act, and do nothing."""
    m = warp_model
    return {
        "opt": dataclasses.replace(
            m.opt, disableflags=int(m.opt.disableflags) & ~int(mjw.DisableBit.ACTUATION)
        ),
        "actuator_gaintype": wp.full_like(m.actuator_gaintype, SWITCHED_OFF),
        "actuator_biastype": wp.full_like(m.actuator_biastype, SWITCHED_OFF),
        "actuator_dyntype": wp.full_like(m.actuator_dyntype, int(mjw.DynType.NONE)),
        "actuator_forcelimited": wp.zeros_like(m.actuator_forcelimited),
        "jnt_actfrclimited": wp.zeros_like(m.jnt_actfrclimited),
        "tendon_actfrclimited": wp.zeros_like(m.tendon_actfrclimited),
        "jnt_actgravcomp": wp.zeros_like(m.jnt_actgravcomp),
    }


class _LastReadings:
    """Velocities and passive forces that the last stage of Runge-Kutta read."""

    def __init__(self, warp_data_E: mjw.Data) -> None:
        self._arrays: list[wp.array] = []
        self._kept: list[wp.array] = []
        for name in READINGS:
            array = vars(warp_data_E)[name]
            self._arrays.append(array)
            self._kept.append(wp.empty_like(array))
        self._stage = 0

    def start(self) -> None:
        """Await the first stage."""
        self._stage = 0

    def take(self) -> None:
        """Launch copies of the readings, while a stage goes on."""
        self._stage += 1
        # A fourth call follows, with the readings of the state that was reached.
        if self._stage > len(STAGE_TIMES):
            return
        for array, kept in zip(self._arrays, self._kept, strict=True):
            wp.copy(kept, array)

    def put_back(self) -> None:
        """Launch copies of the values that were taken last."""
        for array, kept in zip(self._arrays, self._kept, strict=True):
            wp.copy(array, kept)


class _StageClock:
    """The time of the worlds while a stage reads delayed controls: MuJoCo Warp lets it stand still."""

    def __init__(self, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        # The Data's own clock is moved, since kernels of delays read it.
        self._time_E = warp_data_E.time
        self._before_E = wp.zeros_like(warp_data_E.time)
        self._timestep = warp_model.opt.timestep
        self._stage = 0

    def start(self) -> None:
        """Take the present time as the first stage's."""
        self._stage = 0
        wp.copy(self._before_E, self._time_E)

    def advance(self) -> None:
        """Launch the time of the next stage."""
        fraction = STAGE_TIMES[self._stage]
        self._stage += 1
        inputs = [self._before_E, self._timestep, fraction]
        wp.launch(
            kernels.shifted_time, dim=self._time_E.shape, inputs=inputs, outputs=[self._time_E]
        )

    def put_back(self) -> None:
        """Launch the time of the first stage again, from which the step goes on."""
        wp.copy(self._time_E, self._before_E)


class _ExactFilters:
    """Activations of exact filters, which MuJoCo Warp moves to a stage by a part of their exact path over the step."""

    def __init__(self, warp_model: mjw.Model, warp_data_E: mjw.Data) -> None:
        is_exact = warp_model.actuator_dyntype.numpy() == int(mjw.DynType.FILTEREXACT)
        self.exist = bool(is_exact.any())
        self._actuators = wp.array(
            np.flatnonzero(is_exact), dtype=int, device=warp_data_E.act.device
        )
        self._warp_model = warp_model
        self._warp_data_E = warp_data_E
        self._stage = 0

    def start(self) -> None:
        """Await the first stage after the beginning of the step."""
        self._stage = 0

    def rate(self) -> None:
        """Advance them by their rate, before the stage computes the next one."""
        m = self._warp_model
        d = self._warp_data_E
        fraction = STAGE_TIMES[self._stage]
        self._stage += 1
        inputs = [
            self._actuators,
            m.actuator_actadr,
            m.actuator_dynprm,
            m.opt.timestep,
            d.act_dot,
            fraction,
        ]
        dim = (d.nworld, self._actuators.size)
        wp.launch(kernels.rate_exact_filters, dim=dim, inputs=inputs, outputs=[d.act])


def _with_hooks(callback: mjw.Callback, hooks: dict[str, list[Callable[[], None]]]) -> mjw.Callback:
    """Return a copy of the callbacks in which hooks precede the program's own callback of that name."""
    hooked: dict[str, Callable[..., None]] = {}
    # The program's own callback still runs, after ours.
    for name, launches in hooks.items():
        hooked[name] = _in_turn(launches, vars(callback)[name])
    return dataclasses.replace(callback, **hooked)


def _in_turn(
    launches: list[Callable[[], None]], own: Callable[..., None] | None
) -> Callable[..., None]:
    def all_of_them(*model_and_data: mjw.Model | mjw.Data) -> None:
        for launch in launches:
            launch()
        if own is not None:
            own(*model_and_data)

    return all_of_them
