"""A model is refused here before kernels are compiled for it, if a number is not finite or Warp lacks a feature."""

import warnings
from collections.abc import Collection, Iterable, Iterator

import mujoco
import mujoco_warp as mjw
import numpy as np

from ksim_rl.physics.constants.least_weights import SHARE, weightless_pairs
from ksim_rl.physics.sensors.sensor_checks import check_sensors

# Where a field's prefix is not the name of MuJoCo's type of object.
TYPES_OF_PREFIXES = {"jnt": "joint", "cam": "camera", "mat": "material", "eq": "equality"}
# The largest number that the float32 of the GPU holds.
LARGEST = float(np.finfo(np.float32).max)
DERIVED = (
    "invweight0",
    "acc0",
    "aabb",
    "rbound",
    "length0",
    "subtreemass",
    "mat0",
    "pos0",
    "poscom0",
)
# Fields whose enum values tell which elements use a feature that Warp lacks.
ENUM_FIELDS = {
    "actuator_trntype": mujoco.mjtTrn,
    "actuator_dyntype": mujoco.mjtDyn,
    "actuator_gaintype": mujoco.mjtGain,
    "actuator_biastype": mujoco.mjtBias,
    "eq_type": mujoco.mjtEq,
    "geom_type": mujoco.mjtGeom,
    "sensor_type": mujoco.mjtSensor,
}
MOST_TIMESTEP = 0.1
# Numbers that are negative by mistake only.
_OPTIONS = (
    "iterations ls_iterations ccd_iterations noslip_iterations sdf_iterations sdf_initpoints density viscosity "
    "impratio"
)
_FIELDS = (
    "dof_damping dof_frictionloss dof_armature tendon_damping tendon_frictionloss geom_friction pair_friction "
    "actuator_damping"
)
NOT_NEGATIVE_OPTIONS = tuple(_OPTIONS.split())
NOT_NEGATIVE_FIELDS = tuple(_FIELDS.split())
CALLBACKS = {field: getattr(mujoco, f"get_mjcb_act_{field}") for field in ("dyn", "gain", "bias")}
FREE = mujoco.mjtJoint.mjJNT_FREE


def check_finite(mj_model: mujoco.MjModel, source: str) -> None:
    """Refuse a model with a number that is NaN, infinite, or too large for float32."""
    for field, values in _float_fields(mj_model):
        # Compared in float64, in which a number beyond float32 is still finite.
        flat = np.asarray(values, dtype=np.float64).reshape(-1)
        # Written so that NaN, which no comparison holds for, is bad as well.
        bad = np.flatnonzero(~(np.abs(flat) <= LARGEST))
        if bad.size:
            where = _element_of(mj_model, field, int(bad[0]), np.shape(values))
            raise ValueError(
                f"{source}: {field}={flat[bad[0]]} in {where}: every number of a model must be finite and fit float32"
            )


def check_meant(mj_model: mujoco.MjModel, source: str) -> None:
    """Refuse numbers that MuJoCo accepts by mistake: a time step out of (0, 0.1] s, negative counts and losses."""
    step = float(mj_model.opt.timestep)
    if not 0.0 < step <= MOST_TIMESTEP:
        raise ValueError(
            f"{source}: option.timestep={step:g} in <option>: expected (0, {MOST_TIMESTEP}] s; a step of physics, and "
            "not of control, which is decimation times that"
        )
    for name in NOT_NEGATIVE_OPTIONS:
        if (value := getattr(mj_model.opt, name)) < 0:
            raise ValueError(f"{source}: option.{name}={value:g} in <option>: expected at least 0")
    # The first parameter of these gains is a factor; other gains use it in their own way.
    direct = np.isin(
        mj_model.actuator_gaintype,
        (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)),
    )
    fields = {name: np.asarray(getattr(mj_model, name)) for name in NOT_NEGATIVE_FIELDS}
    fields["actuator_gainprm"] = np.where(direct[:, None], mj_model.actuator_gainprm[:, :1], 0.0)
    for field, values in fields.items():
        bad = np.flatnonzero(values < 0.0)
        if bad.size:
            where = _element_of(mj_model, field, int(bad[0]), values.shape)
            raise ValueError(
                f"{source}: {field}={values.flat[bad[0]]:g} in {where}: expected at least 0"
            )
    # Without a callback, such an actuator has no law.
    for field, callback in CALLBACKS.items():
        user = ENUM_FIELDS[f"actuator_{field}type"].__members__[f"mj{field.upper()}_USER"]
        users = np.flatnonzero(getattr(mj_model, f"actuator_{field}type") == int(user))
        if users.size and callback() is None:
            raise ValueError(
                f"{source}: {field}type='user' in {_element(mj_model, 'actuator', int(users[0]))}: it needs a "
                f"callback, and there is none: give one to mujoco.set_mjcb_act_{field} and to "
                f"world.warp_model.callback.act_{field}"
            )


def warp_model_of(mj_model: mujoco.MjModel, batch_sizes: dict[str, int] | None = None) -> mjw.Model:
    """Put a model on Warp's current device, or name the feature that MuJoCo Warp does not have, or has wrong."""
    # Features that `put_model` takes and computes otherwise than C come first.
    check_sensors(mj_model)
    check_fluid(mj_model)
    check_motors(mj_model)
    _check_still_tendons(mj_model)
    try:
        with warnings.catch_warnings():
            # It doubts friction of geoms without contacts; MuJoCo itself accepts them.
            warnings.filterwarnings("ignore", message=".*may cause NaN")
            check_flags(mj_model)
            return mjw.put_model(mj_model, batch_sizes)
    except (NotImplementedError, ValueError) as error:
        raise ValueError(
            f"MuJoCo Warp cannot simulate this model: {_with_elements(mj_model, str(error))}"
        ) from error


def check_flags(mj_model: mujoco.MjModel) -> None:
    """Refuse flags that MuJoCo Warp does not have, with NotImplementedError: its own check names no two together."""
    opt = mj_model.opt
    names = []
    for flags, kind, theirs in (
        (opt.disableflags, mujoco.mjtDisableBit, mjw.DisableBit),
        (opt.enableflags, mujoco.mjtEnableBit, mjw.EnableBit),
    ):
        known = {int(bit) for bit in theirs}
        for name, bit in kind.__members__.items():
            # The count of all bits is a member, too.
            is_flag = not name.startswith("mjN")
            if is_flag and flags & int(bit) and int(bit) not in known:
                names.append(name)
    if names:
        raise NotImplementedError(
            f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} unsupported."
        )


def check_fluid(mj_model: mujoco.MjModel) -> None:
    """Refuse ellipsoids in a fluid, on bodies of several joints, with the integrator that takes their derivative wrong.

    MuJoCo Warp keeps its matrix for "implicit" symmetric, which this derivative is not; "implicitfast" makes it so in C
    as well. A body with a free joint alone is solved for on its own, rightly.
    """
    opt = mj_model.opt
    # Without a fluid, or with another integrator, nothing is computed wrong.
    if opt.integrator != mujoco.mjtIntegrator.mjINT_IMPLICIT or not (
        opt.density > 0 or opt.viscosity > 0
    ):
        return
    for geom in np.flatnonzero(mj_model.geom_fluid[:, 0] > 0):
        body = int(mj_model.geom_bodyid[geom])
        # All bodies of the tree, since the derivative couples its joints.
        tree = mj_model.body_rootid == mj_model.body_rootid[body]
        moving = np.flatnonzero(tree & (mj_model.body_dofnum > 0))
        is_lone = moving.size == 1 and mj_model.jnt_type[mj_model.body_jntadr[moving[0]]] == FREE
        if moving.size and not is_lone:
            raise ValueError(
                f"{_element(mj_model, 'geom', int(geom))} has fluidshape='ellipsoid', and MuJoCo Warp takes the "
                "derivative of its drag wrong for integrator='implicit': choose integrator='implicitfast' "
                "(task.sim.integrator)"
            )


def check_motors(mj_model: mujoco.MjModel) -> None:
    """Refuse DC motors with activations and Runge-Kutta: MuJoCo Warp moves these by whole timesteps in each stage."""
    if mj_model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
        return
    is_motor = mj_model.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR
    for actuator in np.flatnonzero(is_motor & (mj_model.actuator_actnum > 0)):
        raise ValueError(
            f"{_element(mj_model, 'actuator', int(actuator))} is a DC motor with activations, which MuJoCo Warp takes "
            "wrong in the stages of integrator='RK4': choose integrator='implicitfast' (task.sim.integrator)"
        )


def _check_still_tendons(mj_model: mujoco.MjModel) -> None:
    """Refuse constraints of tendons that lie on one rigid body: no joint moves them, so that they weigh nothing.

    Their rows are as hard as numbers allow, on a Jacobian of rounding errors, and their forces are noise, in C too.
    """
    # Found once, since an equality may tie two such tendons.
    still = {tendon for tendon in range(mj_model.ntendon) if _is_still(mj_model, tendon)}
    for tendon in sorted(still):
        if why := _constraint_of_still_tendon(mj_model, tendon, still):
            raise ValueError(
                f"{_element(mj_model, 'tendon', tendon)} lies on one rigid body, but {why}: no joint can do anything "
                "about that, and its force would be rounding error. Let it span a joint, or remove what holds it"
            )


def _constraint_of_still_tendon(
    mj_model: mujoco.MjModel, tendon: int, still: Collection[int]
) -> str | None:
    m = mj_model
    if m.tendon_frictionloss[tendon] > 0.0:
        return "it has a frictionloss"
    # Its length is a constant: the range is violated always or never.
    length = m.tendon_length0[tendon]
    margin = m.tendon_margin[tendon]
    low, high = m.tendon_range[tendon]
    if m.tendon_limited[tendon] and (length - low < margin or high - length < margin):
        return f"its length, {length:.3g}, violates its range"
    # An equality of two tendons that are both still is as fixed as one of a single tendon.
    for equality in np.flatnonzero(m.eq_type == mujoco.mjtEq.mjEQ_TENDON):
        other = int(m.eq_obj2id[equality])
        if m.eq_obj1id[equality] == tendon and (other < 0 or other in still):
            return "an equality holds it"
    return None


def _is_still(mj_model: mujoco.MjModel, tendon: int) -> bool:
    """Whether all that a spatial tendon goes by belongs to one rigid body."""
    first = mj_model.tendon_adr[tendon]
    bodies = set()
    for wrap in range(first, first + mj_model.tendon_num[tendon]):
        # A joint in the path moves the tendon; a pulley belongs to no body.
        kind = mj_model.wrap_type[wrap]
        owner = mj_model.wrap_objid[wrap]
        if kind == mujoco.mjtWrap.mjWRAP_JOINT:
            return False
        if kind == mujoco.mjtWrap.mjWRAP_SITE:
            bodies.add(int(mj_model.body_weldid[mj_model.site_bodyid[owner]]))
        elif kind != mujoco.mjtWrap.mjWRAP_PULLEY:
            bodies.add(int(mj_model.body_weldid[mj_model.geom_bodyid[owner]]))
    return len(bodies) == 1


def check_not_simple(mj_model: mujoco.MjModel, per_world_fields: Iterable[str]) -> None:
    """Refuse moving centres of mass of bodies whose inertia was compiled as diagonal: Warp would keep it diagonal."""
    # Body 0, the world, never moves.
    moving = sorted({"body_ipos", "body_iquat"} & set(per_world_fields))
    simple = np.flatnonzero(mj_model.body_simple[1:]) + 1
    if moving and simple.size:
        raise ValueError(
            f"per_world_fields has {moving[0]!r}, but {_element(mj_model, 'body', int(simple[0]))} is compiled as "
            "simple, with its centre of mass fixed at its origin: call prepare_spec(spec, per_world_fields) before "
            'compiling, or set simple="false" in its XML'
        )


def warn_of_weightless(mj_model: mujoco.MjModel) -> None:
    """Warn of a geom on a body that turns about its centre of mass where it may touch what is fixed.

    MuJoCo gives the contact no weight, and worlds a little; `least_weights` has both.
    """
    found = weightless_pairs(mj_model)
    if found.size:
        first, second = (_element(mj_model, "geom", int(geom)) for geom in found[0])
        warnings.warn(
            f"{first} and {second} may touch; one is fixed and the other turns about its centre of mass: "
            "MuJoCo gives their contact no weight, so that C's forces are rounding errors; here the body has "
            f"{SHARE:g} of its mass's inverse weight in all contacts. Move the joint away from the centre of mass, or "
            "keep the two apart by contype or <exclude/>",
            stacklevel=3,
        )


def check_asleep(mj_model: mujoco.MjModel) -> None:
    """Refuse equalities of tendons where trees may sleep: MuJoCo ends the program that steps them."""
    tied = np.flatnonzero(mj_model.eq_type == mujoco.mjtEq.mjEQ_TENDON)
    if tied.size and mj_model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        raise ValueError(
            f"{_element(mj_model, 'eq', int(tied[0]))} ties tendons, and <flag sleep='enable'/> lets trees sleep, "
            "which MuJoCo does not support together: leave out one of the two"
        )


def _float_fields(mj_model: mujoco.MjModel) -> Iterator[tuple[str, float | np.ndarray]]:
    # Numbers of the options, then of the model itself.
    for name in dir(mj_model.opt):
        value = getattr(mj_model.opt, name)
        if not name.startswith("_") and isinstance(value, (float, np.ndarray)):
            yield f"option.{name}", value
    # Derived fields come last, so that an error names the field that the user wrote.
    for name in sorted(dir(mj_model), key=lambda name: (name.endswith(DERIVED), name)):
        # Textures hold pixels only.
        if name.startswith("_") or name.startswith("tex_"):
            continue
        value = getattr(mj_model, name)
        if isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating):
            yield name, value


def _element_of(
    mj_model: mujoco.MjModel, field: str, flat_index: int, shape: tuple[int, ...]
) -> str:
    """Name the element that a number of a field belongs to."""
    if field.startswith("option."):
        return "<option>"
    # Rows of a field with more dims hold several numbers.
    row = flat_index // max(1, int(np.prod(shape[1:])))
    prefix = field.split("_")[0]
    # A degree of freedom or position has no name: its joint's is given.
    if prefix == "dof":
        prefix = "jnt"
        row = int(mj_model.dof_jntid[row])
    elif field in ("qpos0", "qpos_spring"):
        prefix = "jnt"
        row = int(np.searchsorted(mj_model.jnt_qposadr, row, side="right")) - 1
    return _element(mj_model, prefix, row)


def _element(mj_model: mujoco.MjModel, prefix: str, row: int) -> str:
    word = TYPES_OF_PREFIXES.get(prefix, prefix)
    kind = mujoco.mju_str2Type(word)
    if not kind:
        return f"row {row}"
    name = mujoco.mj_id2name(mj_model, kind, row)
    if name:
        return f"{word} {name!r}"
    return f"{word} number {row} (unnamed)"


def _with_elements(mj_model: mujoco.MjModel, message: str) -> str:
    """Add the elements that use a feature named in a message of put_model, and what to do."""
    users = []
    # The message has the names of enum members; which elements use them, it does not say.
    for field, enum in ENUM_FIELDS.items():
        for row, value in enumerate(getattr(mj_model, field)):
            if enum(int(value)).name in message:
                users.append(_element(mj_model, field.split("_")[0], row))
    if "Actuator plugin" in message:
        plugins = np.flatnonzero(mj_model.actuator_plugin != -1)
        users += [_element(mj_model, "actuator", int(i)) for i in plugins]
    for name in ("Integrator", "Cone", "Solver", "DisableBit", "EnableBit"):
        users += [
            "<option>" for member in getattr(mujoco, f"mjt{name}").__members__ if member in message
        ]
    if users:
        used_by = f" Used by {', '.join(users[:5])}."
    else:
        used_by = ""
    remedy = "Remove it from the model, or replace it by a supported feature."
    # The user can change a solver without touching the model.
    if "mjSOL_" in message:
        remedy = (
            "Lay a supported solver over it: load_model(..., sim=SimCfg(solver='newton')), or task.sim.solver=newton "
            "for an env."
        )
    return f"{message.rstrip('.')}.{used_by} {remedy}"


def model_bytes(mj_model: mujoco.MjModel) -> np.ndarray:
    """Return a model in MuJoCo's binary format, uint8."""
    data = np.empty(mujoco.mj_sizeModel(mj_model), dtype=np.uint8)
    mujoco.mj_saveModel(mj_model, None, data)
    return data
