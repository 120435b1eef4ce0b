"""Lets fields that differ between worlds have the effect that they have in a model compiled with them.

C and MuJoCo Warp leave out effects that a model's own numbers do not ask for, such as adhesion where none is given. A
world may draw such numbers later. An effect that can be switched on is; fields whose effect hangs on memory or tables
that the model does not have are refused by name.
"""

import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

# What builders of our kernels look at, and a value that asks for all of it: a solref below 0 is a stiffness, and ranges
# without a width lie within their margins.
_LOOKED_AT = {
    **dict.fromkeys(("body_gravcomp", "geom_margin", "geom_gap", "pair_margin", "pair_gap"), 1.0),
    **dict.fromkeys(("geom_solref", "pair_solref"), -1.0),
    "jnt_range": 0.0,
    "jnt_margin": 1e9,
}
_PLACES = ("actuator_history", "actuator_historyadr", "sensor_history", "sensor_historyadr")


def check_effects(mj_model: mujoco.MjModel, expanded: Collection[str]) -> None:
    """Refuse fields that could not have their effect in this model, by name."""
    for field in _PLACES:
        if field in expanded:
            raise ValueError(
                f"per_world_fields has {field!r}, which says where past values lie and is the same in all worlds: "
                "leave it out; delays are in actuator_delay and sensor_delay"
            )
    # Each with the elements that lack the memory for it.
    lacking = {
        "jnt_springyield": (mj_model.jnt_plasticadr < 0, "no joint yields", "give one springyield"),
        "tendon_springyield": (
            mj_model.tendon_plasticadr < 0,
            "no tendon yields",
            "give one springyield",
        ),
        "actuator_delay": (
            mj_model.actuator_history[:, 0] < 1,
            "no actuator is delayed",
            "give one nsample",
        ),
        "sensor_delay": (
            mj_model.sensor_history[:, 0] < 1,
            "no sensor is delayed",
            "give one nsample",
        ),
        "sensor_interval": (
            mj_model.sensor_history[:, 0] < 1,
            "no sensor is delayed",
            "give one nsample",
        ),
    }
    for field, (lacks, what, remedy) in lacking.items():
        if field in expanded and lacks.all():
            raise ValueError(
                f"per_world_fields has {field!r}, but {what} in the model, so that it has no memory for that: {remedy} "
                "in its XML, or leave the field out"
            )
    # The mass of the moved fluid is compiled from the geom's size.
    fluid = mj_model.geom_fluid[:, 0] > 0.0
    if "geom_size" in expanded and mj_model.opt.density > 0.0 and fluid.any():
        geom = mj_model.geom(int(fluid.argmax())).name or f"number {int(fluid.argmax())} (unnamed)"
        raise ValueError(
            f"per_world_fields has 'geom_size', but geom {geom!r} moves the fluid around it, whose mass follows from "
            'that size and is the same in all worlds: leave out fluidshape="ellipsoid" in its XML, or geom_size'
        )
    _warn_of_still_air(mj_model, expanded)
    # A body on slides at right angles has a diagonal inertia matrix.
    slides = (mj_model.body_simple == 2) & (mj_model.body_dofnum > 1)
    if "jnt_axis" in expanded and slides.any():
        raise _not_simple(mj_model, "jnt_axis", int(slides.argmax()), "with slides at right angles")
    turns = _turns_about_centre(mj_model)
    if "jnt_pos" in expanded and turns.any():
        raise _not_simple(
            mj_model, "jnt_pos", int(turns.argmax()), "turning about its centre of mass"
        )


def _warn_of_still_air(mj_model: mujoco.MjModel, expanded: Collection[str]) -> None:
    """Warn of bodies without mass in a fluid: where a world gives one mass, MuJoCo Warp has drag of it wrong."""
    is_fluid = mj_model.opt.density > 0.0 or mj_model.opt.viscosity > 0.0
    moves = mj_model.body_dofnum[mj_model.body_weldid] > 0
    massless = np.flatnonzero(moves & (mj_model.body_mass < mujoco.mjMINVAL))
    if "body_mass" in expanded and is_fluid and massless.size:
        body = mj_model.body(int(massless[0])).name or f"number {massless[0]} (unnamed)"
        warnings.warn(
            f"per_world_fields has 'body_mass', and body {body!r}, which is in a fluid, has no mass in the model: "
            "where a world gives it mass, its drag is not the C engine's. Give it a little mass in the XML",
            stacklevel=4,
        )


def _turns_about_centre(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return the simple bodies with several degrees of freedom and a hinge or ball, bool [nbody].

    Elsewhere, such a joint would couple them, and simple bodies have no room for that.
    """
    turning = np.isin(mj_model.jnt_type, (mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE))
    turns = np.isin(np.arange(mj_model.nbody), mj_model.jnt_bodyid[turning])
    return turns & (mj_model.body_simple > 0) & (mj_model.body_dofnum > 1)


def _not_simple(mj_model: mujoco.MjModel, field: str, body: int, how: str) -> ValueError:
    """Return the error that refuses a field that moves a joint of a body that was compiled as simple."""
    name = mj_model.body(body).name or f"number {body} (unnamed)"
    return ValueError(
        f"per_world_fields has {field!r}, but body {name!r} is compiled as simple, {how}: "
        'call prepare_spec(spec, per_world_fields) before compiling, or set simple="false" in its XML'
    )


def switch_on(mj_model: mujoco.MjModel, expanded: Collection[str]) -> None:
    """Let a model look at fields that its own numbers do not ask for, in place, before MuJoCo Warp takes it over."""
    # Flags that are compiled from the model's own numbers.
    mj_model.flg_gravcomp |= "body_gravcomp" in expanded
    mj_model.flg_surfacevel |= "geom_surfacevel" in expanded
    mj_model.flg_adhesion |= not {"geom_adhesion", "pair_adhesion"}.isdisjoint(expanded)


@contextmanager
def as_if_drawn(warp_model: mjw.Model, expanded: Collection[str]) -> Iterator[None]:
    """Show builders of kernels values of the fields that worlds may draw, instead of those that they begin with."""
    fields = {name: vars(warp_model)[name] for name in _LOOKED_AT if name in expanded}
    # Restored after the block, so that worlds begin with the model's values.
    present = {name: wp.clone(array) for name, array in fields.items()}
    for name, array in fields.items():
        array.fill_(_LOOKED_AT[name])
    try:
        yield
    finally:
        for name, array in fields.items():
            wp.copy(array, present[name])
