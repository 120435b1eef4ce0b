"""Launches MuJoCo Warp's integrators so that they reach the C engine's state; docs/upstream.md shows why.

A shallow variant of the model gives back the derivatives that its implicit integrators leave out:

* Without actuation, or without dampers, they take no derivative at all. C drops only the derivatives of disabled parts.
* They multiply a gain that depends on velocity by controls out of their range, and by another actuator's where
  one has several controls or none.
* Of simple bodies, and of those with a free joint alone, they leave out the coupling of degrees of freedom; see
  `full_rows`.

And an activation of a disabled actuator is put back, and where trees may sleep what the substep read: MuJoCo Warp then
computes velocities, passive forces and forces of bodies once more, of the state that it reached. So are the forces of
bodies that stages of Runge-Kutta leave.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from ksim_rl.physics import kernels, upstream
from ksim_rl.physics.actuators.disabled_actuators import still_activations
from ksim_rl.physics.integration.full_rows import full_rows_matter, implicit_with_full_rows
from ksim_rl.physics.integration.runge_kutta import mended_runge_kutta

_KINDS = mjw.IntegratorType
_IMPLICIT = (_KINDS.IMPLICIT, _KINDS.IMPLICITFAST)
# What is read of the last substep, and computed once more where trees may sleep, and by each stage of Runge-Kutta: that
# keeps the other readings of its last stage itself.
FORCES_OF_STAGES = ("cacc", "cfrc_int")
READ_ONCE = ("actuator_velocity", "qfrc_passive", *FORCES_OF_STAGES)
_DAMPING_FIELDS = (
    *("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly"),
    *("actuator_damping", "actuator_dampingpoly"),
)


def integrator(
    mj_model: mujoco.MjModel,
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    *,
    mend: Callable[[], None] | None = None,
) -> Callable[[mjw.Model], None]:
    """Return a launcher of the integrator of a model, with arrays in their final place.

    It takes the variant of the model that the substep used. `mend` follows the constraint rows of each stage of
    Runge-Kutta. ValueError where C's derivative cannot be had.
    """
    if warp_model.opt.integrator in _IMPLICIT:
        integrate = _implicit(mj_model, warp_model, warp_data_E)
    else:
        integrate = _explicit(warp_model, warp_data_E, mend)
    if warp_model.opt.integrator == _KINDS.RK4:
        kept = FORCES_OF_STAGES
        if warp_model.na > 0 and warp_model.has_actuator_dcmotor:
            # C leaves velocities of the start where a model has DC motors and activations.
            kept = (*kept, "actuator_velocity")
        integrate = _keeping_readings(integrate, warp_data_E, kept)
    # Where trees may sleep, MuJoCo Warp computes some readings once more after the step.
    elif upstream.may_sleep(warp_model.opt):
        integrate = _keeping_readings(integrate, warp_data_E, READ_ONCE)
    # MuJoCo Warp moves activations of disabled actuators; C does not.
    columns = still_activations(mj_model)
    if columns.size == 0:
        return integrate
    still = wp.array(columns, dtype=int)
    # Allocated once: graphs keep its address.
    kept_E = wp.empty_like(warp_data_E.act)
    dim = (warp_data_E.nworld, columns.size)

    def integrate_but_disabled(substep_warp_model: mjw.Model) -> None:
        wp.launch(kernels.copy_columns, dim=dim, inputs=[still, warp_data_E.act], outputs=[kept_E])
        integrate(substep_warp_model)
        wp.launch(kernels.copy_columns, dim=dim, inputs=[still, kept_E], outputs=[warp_data_E.act])

    return integrate_but_disabled


def _keeping_readings(
    integrate: Callable[[mjw.Model], None], warp_data_E: mjw.Data, names: Sequence[str]
) -> Callable[[mjw.Model], None]:
    """Return a launcher of an integrator that puts back arrays which the substep read before it."""
    arrays = [getattr(warp_data_E, name) for name in names]
    kept = [wp.empty_like(array) for array in arrays]

    def integrate_and_put_back(substep_warp_model: mjw.Model) -> None:
        for array, copy in zip(arrays, kept, strict=True):
            wp.copy(copy, array)
        integrate(substep_warp_model)
        for array, copy in zip(arrays, kept, strict=True):
            wp.copy(array, copy)

    return integrate_and_put_back


def _explicit(
    warp_model: mjw.Model, warp_data_E: mjw.Data, mend: Callable[[], None] | None
) -> Callable[[mjw.Model], None]:
    kind = _KINDS(int(warp_model.opt.integrator))
    if kind == _KINDS.RK4:
        return mended_runge_kutta(warp_model, warp_data_E, mend)
    # Kinds other than Runge-Kutta and "discrete" are Euler here.
    if kind == _KINDS.DISCRETE:
        launch = mjw.discrete
    else:
        launch = mjw.euler
    return lambda substep_warp_model: launch(substep_warp_model, warp_data_E)


def _implicit(
    mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data
) -> Callable[[mjw.Model], None]:
    of_integration = _with_all_derivatives(warp_model)
    gathered_E = warp_data_E
    gather = _nothing
    inputs = _inputs_of_gains(mj_model, warp_model, warp_data_E)
    if inputs is not None:
        gather, gathered_E = inputs
    # Our rows of ancestors are needed only where derivatives couple what `M` keeps apart.
    launch = partial(mjw.implicit, of_integration, gathered_E)
    if full_rows_matter(mj_model, of_integration):
        launch = implicit_with_full_rows(mj_model, of_integration, gathered_E)

    def integrate(substep_warp_model: mjw.Model) -> None:
        gather()
        launch()

    return integrate


def _nothing() -> None:
    """Launch nothing."""


def _with_all_derivatives(warp_model: mjw.Model) -> mjw.Model:
    """Return a model in which disabled parts depend on no velocity, so that nothing needs to be disabled."""
    m = warp_model
    bits = mjw.DisableBit
    flags = int(m.opt.disableflags)
    changes = {}
    # A model without actuators has no derivative of theirs; their forces have been computed before.
    if flags & bits.ACTUATION:
        changes["nactuator"] = 0
    # Zero damping has no derivative; passive forces were computed with the model's own.
    if flags & bits.DAMPER:
        for name in _DAMPING_FIELDS:
            changes[name] = wp.zeros_like(getattr(m, name))
    if not changes:
        return m
    # The flags would leave out all derivatives; the fields above leave out the disabled parts' only.
    opt = dataclasses.replace(m.opt, disableflags=flags & ~int(bits.ACTUATION | bits.DAMPER))
    return dataclasses.replace(m, opt=opt, **changes)


def _inputs_of_gains(
    mj_model: mujoco.MjModel, warp_model: mjw.Model, warp_data_E: mjw.Data
) -> tuple[Callable[[], None], mjw.Data] | None:
    """Return a launcher that gathers each actuator's control, within its range, and worlds with these as `ctrl`.

    None where no derivative reads a control.
    """
    m = warp_model
    flags = int(m.opt.disableflags)
    # Only a gain that depends on velocity multiplies a control in the derivative.
    if flags & mjw.DisableBit.ACTUATION or not _gain_depends_on_velocity(m):
        return None
    if not flags & mjw.DisableBit.CLAMPCTRL:
        ranges = mj_model.actuator_ctrllimited
    else:
        ranges = np.zeros(0)
    # In range and one for each actuator, the controls are right as they are.
    if not np.any(ranges) and _has_own_controls(mj_model):
        return None
    if np.any(
        mj_model.actuator_gaintype == mujoco.mjtGain.mjGAIN_DCMOTOR
    ) and not _has_own_controls(mj_model):
        raise ValueError(
            "a gain depends on velocity, and a DC motor has several controls or none: MuJoCo Warp's implicit "
            "integrators mix their controls up; choose integrator='euler', or drop one of the two actuators"
        )
    d = warp_data_E
    # One gathered control for each actuator, [E, nu].
    gathered = wp.zeros((d.nworld, m.nactuator), dtype=float)
    inputs = [
        *(m.actuator_ctrladr, m.actuator_ctrlnum, m.actuator_ctrllimited, m.actuator_ctrlrange),
        *(bool(flags & mjw.DisableBit.CLAMPCTRL), d.ctrl),
    ]

    def gather() -> None:
        wp.launch(kernels.gather_controls, dim=gathered.shape, inputs=inputs, outputs=[gathered])

    return gather, dataclasses.replace(d, ctrl=gathered)


def _gain_depends_on_velocity(warp_model: mjw.Model) -> bool:
    # Only affine gains without an activation have their velocity term in the derivative.
    affine = warp_model.actuator_gaintype.numpy() == mujoco.mjtGain.mjGAIN_AFFINE
    stateless = warp_model.actuator_dyntype.numpy() == mujoco.mjtDyn.mjDYN_NONE
    gains = warp_model.actuator_gainprm
    may_differ = gains.shape[0] > 1
    # Fields that differ between worlds may be written at any time.
    if may_differ:
        depends = np.ones(affine.size, dtype=bool)
    else:
        depends = gains.numpy()[0, :, 2] != 0.0
    return bool(np.any(affine & stateless & depends))


def _has_own_controls(mj_model: mujoco.MjModel) -> bool:
    """Whether actuator i has control i, and no other."""
    return np.array_equal(mj_model.actuator_ctrladr, np.arange(mj_model.nu)) and bool(
        np.all(mj_model.actuator_ctrlnum == 1)
    )
