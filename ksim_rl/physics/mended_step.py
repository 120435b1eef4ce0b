"""This module launches a whole step of MuJoCo Warp's in which its constraint rows are mended, once it has made them."""

import dataclasses
from collections.abc import Callable
from typing import Any

import mujoco_warp as mjw


def hook_after_rows(warp_model: mjw.Model) -> str | None:
    """Return the callback that MuJoCo Warp calls between its rows and its solver, or None if its flags leave none."""
    flags, bits = int(warp_model.opt.disableflags), mjw.DisableBit
    if not (flags & bits.SPRING and flags & bits.DAMPER):
        return "passive"
    return None if flags & bits.ACTUATION else "control"


def mended_step(warp_model: mjw.Model, warp_data_E: mjw.Data, mend_rows: Callable[[], None] | None) -> None:
    """Launch `mjw.step`, and `mend_rows` after the rows of each of its stages, of which Runge-Kutta's has four."""
    if mend_rows is None:
        mjw.step(warp_model, warp_data_E)
        return
    callback, hook = warp_model.callback, hook_after_rows(warp_model)
    if hook is None:
        raise ValueError(
            "the model ties a body without joints, springs, dampers and actuation are disabled, and MuJoCo Warp's own "
            "solver is used: its rows of that body cannot be mended. Enable one of the three in <flag/>, or use "
            'a dense Jacobian (<option jacobian="dense"/>)'
        )
    own = vars(callback)[hook]

    def mended(*model_and_data: Any) -> None:
        mend_rows()
        if own is not None:
            own(*model_and_data)

    # Of a copy, since callbacks of forces are otherwise a program's.
    hooked = dataclasses.replace(callback, **{hook: mended})
    mjw.step(dataclasses.replace(warp_model, callback=hooked), warp_data_E)
