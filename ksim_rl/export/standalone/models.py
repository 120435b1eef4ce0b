"""Reads the model and the recorded starts of an exported folder, which may be a stranger's, for MuJoCo."""

import math
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from ksim_rl.export.standalone.description import Export
from ksim_rl.export.standalone.files import Array, check_closed

# What an export writes of the model's fields where worlds differ: numbers, and none by which C finds other numbers.
_FIELDS = {
    "qpos0": "",
    "qpos": "spring",
    "body": "pos quat ipos iquat mass subtreemass inertia invweight0 gravcomp",
    "jnt": "solref solimp pos axis stiffness stiffnesspoly springyield range actfrcrange margin",
    "dof": "solref solimp frictionloss armature damping dampingpoly invweight0",
    "geom": "solmix solref solimp size aabb rbound pos quat friction margin gap surfacevel adhesion rgba",
    "site": "pos quat",
    "cam": "pos quat poscom0 pos0 mat0 fovy intrinsic",
    "light": "pos dir poscom0 pos0 dir0 attenuation cutoff exponent ambient diffuse specular",
    "mat": "texrepeat emission specular shininess rgba",
    "pair": "solref solreffriction solimp margin gap adhesion friction",
    "eq": "solref solimp data",
    "tendon": "solref_lim solimp_lim solref_fri solimp_fri range actfrcrange margin stiffness stiffnesspoly damping "
    "dampingpoly armature frictionloss lengthspring springyield length0 invweight0",
    "actuator": "cranklength dynprm gainprm biasprm actrange damping dampingpoly armature forcerange ctrlrange gear "
    "acc0 lengthrange",
}
FIELDS = frozenset(
    f"{kind}_{name}" for kind, names in _FIELDS.items() for name in names.split()
) | {"qpos0"}
# Which mesh or height field a geom has; each that the model has may stand in the place of another of its kind.
CHOICE = "geom_dataid"


def read_model(folder: Path) -> mujoco.MjModel:
    """Return the model of `robot.xml`, which may name regular files of its own folder only."""
    path = folder / "robot.xml"
    # Before MuJoCo sees it: its parser opens the files that it names.
    check_closed(path)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from None


def check_record(
    path: Path, record: Mapping[str, Array], meta: Export, mj_model: mujoco.MjModel
) -> int:
    """Return how many episodes a record has, or refuse it: everything that it writes into the model has to fit.

    A model's field is one of `FIELDS`, of finite numbers and the model's own shape.
    """
    # All shapes follow from the model and the metadata, which were checked before.
    joints = len(meta["joints"]["names"])
    shapes = {
        "qpos": (mj_model.nq,),
        "qvel": (mj_model.nv,),
        "ctrl": (mj_model.nu,),
        "act": (mj_model.na,),
    }
    shapes |= {
        "mocap_pos": (mj_model.nmocap, 3),
        "mocap_quat": (mj_model.nmocap, 4),
        "gravity": (3,),
    }
    shapes |= {"encoder_bias": (joints,), "default_pos": (joints,)}
    # Its first axis is the number of episodes, which all others must have.
    if (
        "start/qpos" not in record
        or record["start/qpos"].ndim != 2
        or not len(record["start/qpos"])
    ):
        raise ValueError(f"{path}: no 'start/qpos' of [episodes, {mj_model.nq}] numbers")
    episodes = len(record["start/qpos"])
    for name, value in record.items():
        kind, _, rest = name.partition("/")
        if kind == "start":
            # By joint, in the export's order: gains and limits of the laws.
            if rest.startswith("actuator/"):
                shape = (joints,)
            else:
                shape = shapes.get(rest)
            if rest.startswith("model/"):
                shape = _check_field(path, rest.removeprefix("model/"), value, mj_model)
            if shape is None:
                raise ValueError(f"{path}: {name!r}: no part of the start of an episode")
            _check_shape(path, name, value, (episodes, *shape))
    # [episodes, steps, size]: steps may be any number, but at least one for `reset` to read.
    for name, command in meta["commands"].items():
        values = record.get(f"command/{name}", np.zeros(0))
        if values.ndim != 3 or values.shape[0] != episodes or values.shape[1] < 1:
            raise ValueError(
                f"{path}: no 'command/{name}' of [{episodes}, steps, {command['size']}] numbers"
            )
        _check_shape(path, f"command/{name}", values, (*values.shape[:2], command["size"]))
    # Rows of episode, step, change of qvel [nv].
    pushes = record.get("pushes", np.zeros(0))
    _check_shape(path, "pushes", pushes, (len(pushes), 2 + mj_model.nv))
    return episodes


def _check_field(path: Path, field: str, value: Array, mj_model: mujoco.MjModel) -> tuple[int, ...]:
    """Return the shape that a field of the model has, as an export writes it; refuse one that none writes."""
    if field not in FIELDS | {CHOICE}:
        raise ValueError(f"{path}: 'start/model/{field}' is no field that an export writes")
    # Refused above unless it is one of the list, so this reads no other attribute.
    own = getattr(mj_model, field)
    if field == CHOICE:
        _check_choice(path, value, mj_model)
    elif value.dtype.kind != "f":
        raise ValueError(f"{path}: 'start/model/{field}' is {value.dtype}: expected floats")
    # MuJoCo Warp has matrices where C has rows of nine.
    shape = value.shape[1:]
    # The same count and the same first axis: only trailing axes may be folded differently.
    if math.prod(shape) != own.size or shape[:1] != own.shape[:1]:
        raise ValueError(
            f"{path}: 'start/model/{field}' is {shape} in each episode, and {own.shape} in the model"
        )
    return shape


def _check_choice(path: Path, value: Array, mj_model: mujoco.MjModel) -> None:
    # How many assets there are of each kind that geom_dataid can point at; other geoms have -1.
    counts = {
        mujoco.mjtGeom.mjGEOM_HFIELD: mj_model.nhfield,
        mujoco.mjtGeom.mjGEOM_MESH: mj_model.nmesh,
    }
    for geom, kind in enumerate(mj_model.geom_type.tolist()):
        chosen = value[..., geom]
        own = mj_model.geom_dataid[geom]
        count = counts.get(mujoco.mjtGeom(kind), 0)
        # Either unchanged, or an asset of the same kind that exists. C does not check the index.
        fits = (chosen == own) | ((chosen >= 0) & (chosen < count) & (own >= 0))
        if value.dtype.kind != "i" or not bool(np.all(fits)):
            raise ValueError(
                f"{path}: 'start/model/{CHOICE}' names what geom {geom} of the model cannot be"
            )


def _check_shape(path: Path, name: str, value: Array, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise ValueError(f"{path}: {name!r} is {value.shape}: expected {shape}")
    # MuJoCo would only warn about NaN, and reset the state.
    if not np.isfinite(value).all():
        raise ValueError(f"{path}: {name!r} holds numbers that are not finite")
