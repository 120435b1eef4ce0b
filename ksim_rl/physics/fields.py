"""Lists the model fields that may differ between worlds, and the constants that follow from them."""

from collections.abc import Iterable, Mapping, Sequence

import mujoco
import mujoco_warp as mjw
import numpy as np

from ksim_rl.checks import check_known
from ksim_rl.physics.upstream import per_world_fields

FIXED, KIN0, INERT0 = (int(mjw.SetConstGroup[name]) for name in ("FIXED", "KIN0", "INERT0"))
ALL = FIXED | KIN0 | INERT0

# The constants that mj_setConst derives from a field (see mujoco_warp.set_const); `actuator_gear` scales the moments.
_FIELDS_OF_GROUPS = {
    ALL: "body_mass",
    FIXED: "geom_size",
    KIN0: "eq_data cam_pos cam_quat light_pos light_dir",
    KIN0 | INERT0: "qpos0 body_ipos body_pos body_quat jnt_pos jnt_axis",
    INERT0: "body_inertia body_iquat dof_armature tendon_armature actuator_armature actuator_gear",
}
GROUPS_OF_FIELD = {
    name: groups for groups, names in _FIELDS_OF_GROUPS.items() for name in names.split()
}
DERIVED_FIELDS = {
    FIXED: "body_subtreemass geom_aabb geom_rbound",
    KIN0: "tendon_length0 eq_data cam_pos0 cam_poscom0 cam_mat0 light_pos0 light_poscom0 light_dir0",
    INERT0: "dof_invweight0 body_invweight0 tendon_invweight0 actuator_acc0",
}
# The elements that paths pass: tendons over sites and geoms, and transmissions from sites.
_PATH_FIELDS = {
    "geom_size",
    "geom_pos",
    "geom_quat",
    "site_pos",
    "site_quat",
    "actuator_cranklength",
}
_PATH_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_SITE, mujoco.mjtTrn.mjTRN_SLIDERCRANK)
# Not a field of the model but of its options, which put_model cannot expand.
GRAVITY = "gravity"


def const_groups(fields: Iterable[str], mj_model: mujoco.MjModel) -> int:
    """Return the `SetConstGroup` bits of the constants that follow from `fields` in a model."""
    has_paths = bool(np.isin(mj_model.actuator_trntype, _PATH_TRANSMISSIONS).any())
    has_paths |= bool((mj_model.wrap_type != mujoco.mjtWrap.mjWRAP_JOINT).any())
    # Joint tendons have no path in space, and others do.
    groups = 0
    for field in fields:
        groups |= GROUPS_OF_FIELD.get(field, 0)
        if has_paths and field in _PATH_FIELDS:
            groups |= KIN0 | INERT0
    return groups


def derived_fields(groups: int) -> tuple[str, ...]:
    """Return the names of the constants of these `SetConstGroup` bits."""
    return tuple(
        name for group, names in DERIVED_FIELDS.items() if groups & group for name in names.split()
    )


def fields_to_expand(fields: Sequence[str], mj_model: mujoco.MjModel) -> tuple[str, ...]:
    """Return `fields` and, after them, the fields that are derived from them and so must differ as well."""
    if isinstance(fields, str):
        raise ValueError(
            f"per_world_fields={fields!r}: expected a sequence of names, such as ({fields!r},)"
        )
    valid = per_world_fields()
    for field in fields:
        check_known("per-world model field", field, (*valid, GRAVITY))
    derived = derived_fields(const_groups(fields, mj_model))
    # Gravity is expanded apart, since it is a field of the options.
    return tuple(dict.fromkeys([*(field for field in fields if field != GRAVITY), *derived]))


def prepare_spec(spec: mujoco.MjSpec, per_world_fields: Iterable[str]) -> None:
    """Switch off specializations of MuJoCo's compiler on fields that are to differ between worlds.

    Call it before the spec is compiled, with the names that `World` gets as `per_world_fields`.
    A body that floats about its centre of mass, or slides along axes at right angles, is compiled as "simple", with a
    diagonal inertia matrix, which a moved centre of mass, or a moved or turned axis, makes wrong.
    """
    if {"body_ipos", "body_iquat", "jnt_axis", "jnt_pos"} & set(per_world_fields):
        for body in spec.bodies:
            body.simple = False


def write_fields(mj_model: mujoco.MjModel, fields: Mapping[str, np.ndarray]) -> None:
    """Write one row of `World.per_world_fields` into a model of the C engine, in place, and the constants of it.

    Fields that the C engine does not know are left out. Raises ValueError where a field has another size in the model.
    """
    _copy_fields(mj_model, fields)
    # Constants do not follow from how things look, nor from gravity.
    shown = ("mat_", "light_", "cam_fovy", "cam_intrinsic", "geom_matid", "geom_rgba", GRAVITY)
    follows = [name for name in fields if name in GROUPS_OF_FIELD or not name.startswith(shown)]
    if follows and all(np.isfinite(value).all() for value in fields.values()):
        # Of frames that its compiler found equal C looks at one, and at gravity compensation if it found any; and the
        # inertia of simple bodies, and margins of whole bodies, are fields that no world has.
        mujoco.mj_setConst(mj_model, mujoco.MjData(mj_model))
        # `mj_setConst` overwrites derived fields; the world has its own.
        _copy_fields(mj_model, fields)


def _copy_fields(mj_model: mujoco.MjModel, fields: Mapping[str, np.ndarray]) -> None:
    for name, value in fields.items():
        if name == GRAVITY:
            target = mj_model.opt.gravity
        else:
            target = getattr(mj_model, name, None)
        # A few of MuJoCo Warp's fields are its own.
        if target is None:
            continue
        if target.size != value.size:
            raise ValueError(f"{name} has {value.size} numbers: the model has {target.size}")
        target[:] = value.reshape(target.shape)
