"""This module launches a whole step of MuJoCo Warp's in which its constraint rows are mended, once it has made them."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import mujoco_warp as mjw


def hook_after_rows(warp_model: mjw.Model) -> str | None:
    """Return the callback that MuJoCo Warp calls between its rows and its solver, or None if its flags leave none."""
    flags, bits = int(warp_model.opt.disableflags), mjw.DisableBit
    if not (flags & bits.SPRING and flags & bits.DAMPER):
        return "passive"
    return None if flags & bits.ACTUATION else "control"


def check_mendable(warp_model: mjw.Model) -> None:
    """Refuse a model whose rows have to be mended, but cannot be within a step of MuJoCo Warp's own."""
    m = warp_model
    if hook_after_rows(m) is None:
        raise ValueError(
            "the model ties a body without joints, or has a range narrower than its margins, while springs, dampers "
            "and actuation are disabled and MuJoCo Warp's own solver is used: its rows of these cannot be mended. "
            "Enable one of the three in <option><flag/></option>"
        )
    is_delayed = m.sensor_history.numpy()[:, :, 0] > 0
    if is_delayed.any(0)[m.sensor_limitpos_adr.numpy()].any():
        raise ValueError(
            "a sensor of the distance to a limit has a delay or an interval, but rows of limits are mended and "
            "MuJoCo Warp's own solver is used, which has read it by then: remove the delay"
        )


def mended_step(
    warp_model: mjw.Model,
    warp_data_E: mjw.Data,
    row_mends: Sequence[Callable[[], None]],
    limits_warp_model: mjw.Model | None = None,
) -> None:
    """Launch `mjw.step`, and `row_mends` after the rows of each of its stages, of which Runge-Kutta's has four.

    Then the sensors of `limits_warp_model`, which has others no more, are computed again, as they read such rows.
    """
    if not row_mends:
        mjw.step(warp_model, warp_data_E)
        return
    callback, hook = warp_model.callback, hook_after_rows(warp_model)
    assert hook is not None, "check_mendable was not called"
    own = vars(callback)[hook]
    reads = [] if warp_model.opt.disableflags & mjw.DisableBit.SENSOR else [limits_warp_model]

    def mended(*model_and_data: Any) -> None:
        for mend in row_mends:
            mend()
        # Later stages of Runge-Kutta compute no sensors.
        if (model := reads.pop() if reads else None) is not None:
            mjw.sensor_pos(model, warp_data_E)
        if own is not None:
            own(*model_and_data)

    # Of a copy, since callbacks of forces are otherwise a program's.
    hooked = dataclasses.replace(callback, **{hook: mended})
    mjw.step(dataclasses.replace(warp_model, callback=hooked), warp_data_E)
