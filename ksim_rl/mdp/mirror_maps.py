"""The left-right mirror image of a policy's observations and actions is found here from the env's own terms."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from ksim_rl import mdp
from ksim_rl.checks import naming, near
from ksim_rl.envs.contract import part
from ksim_rl.envs.manager_based_rl_env import ManagerBasedRlEnv
from ksim_rl.mdp.actions import JointAction, per_joint
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.sensors import ContactSensor
from ksim_rl.scene.sensors.rays import grid_points
from ksim_rl.transforms import (
    AXIAL,
    PLANAR_VELOCITY,
    POLAR,
    QUATERNION,
    MirrorMap,
    group_specs,
    mirror_by_name,
    mirror_group,
    mirror_joints,
)
from ksim_rl.transforms.mirror.mirror import concatenate

_SENSORS = {
    **dict.fromkeys(
        ("GYRO", "TORQUE", "FRAMEANGVEL", "FRAMEANGACC", "BALLANGVEL", "SUBTREEANGMOM"), AXIAL
    ),
    **dict.fromkeys(
        ("VELOCIMETER", "ACCELEROMETER", "FORCE", "FRAMELINVEL", "FRAMELINACC", "FRAMEPOS"), POLAR
    ),
    **dict.fromkeys(("FRAMEXAXIS", "FRAMEZAXIS", "SUBTREECOM", "SUBTREELINVEL"), POLAR),
    **dict.fromkeys(("FRAMEQUAT", "BALLQUAT"), QUATERNION),
}
# By quantity of `ImuReading`.
_IMU = {"ang_vel": AXIAL, "lin_acc": POLAR, "quat": QUATERNION, "projected_gravity": POLAR}
# Above the rounding of float32 angles, far below any asymmetry that is meant.
_TOLERANCE = 1e-4


def mirror_maps(
    env: EnvBase, groups: Sequence[NestedKey] = ("actor", "critic")
) -> dict[NestedKey, MirrorMap]:
    """Return the mirror image of observation groups and of the action, by key, in the plane y = 0 of the world.

    For a robot that is its own mirror image, in a scene and with rewards that are too, the image of an episode is an
    episode. A history repeats the map of its term. A ValueError names a term whose image is not known (register it with
    `term_mirror.register`), and joints, a default pose or an action scale that are not symmetric.
    """
    inner = part(env, ManagerBasedRlEnv)
    specs = group_specs(env)
    # Terms are read from the config, which only this env has.
    if inner is None:
        raise ValueError(
            f"mirror_maps of a {type(env).__name__}: needs a ManagerBasedRlEnv, whose terms it reads"
        )
    maps: dict[NestedKey, MirrorMap] = {}
    for group in groups:
        cfg = inner.cfg.observations.get(str(group))
        # An image has no columns.
        if cfg is not None and any(term.is_image for term in cfg.terms.values()):
            raise ValueError(
                f"group {group!r} is an image, whose mirror image is not known: set objective.symmetry=none"
            )
        if group not in specs:
            raise ValueError(f"no observation group {group!r}: {near(str(group), map(str, specs))}")
        terms = inner.cfg.observations[str(group)].terms
        # A group's terms, each with its own image; `mirror_group` puts them together by the group's spec.
        images: dict[NestedKey, MirrorMap] = {
            name: _named(f"observations.{group}.{name}", term.term, inner)
            for name, term in terms.items()
        }
        maps[group] = mirror_group(specs[group], images)
    maps["action"] = _action(inner)
    return maps


def _named(where: str, term: Any, env: ManagerBasedRlEnv) -> MirrorMap:
    with naming(where):
        return term_mirror(term, env)


@functools.singledispatch
def term_mirror(term: Any, env: ManagerBasedRlEnv) -> MirrorMap:
    """Return the mirror image of an observation term's reading, a command, or the input of an action term.

    Example:
        >>> @term_mirror.register
        ... def _(term: WindDirection, env): return POLAR
    """
    raise ValueError(
        f"the mirror image of {type(term).__name__} is not known: give it with "
        "ksim_rl.mdp.mirror_maps.term_mirror.register"
    )


# Images that do not depend on the term's fields.
_FIXED = {
    **dict.fromkeys((mdp.RootPos, mdp.RootLinVel, mdp.ProjectedGravity), POLAR),
    mdp.RootAngVel: AXIAL,
    mdp.RootQuat: QUATERNION,
    **dict.fromkeys((mdp.EpisodeTime, mdp.RemainingTime), MirrorMap(source=(0,))),
    mdp.UniformVelocityCommand: PLANAR_VELOCITY,
}
for _kind, _image in _FIXED.items():
    # The default binds the image now; a plain closure would see the last one.
    term_mirror.register(_kind, lambda term, env, image=_image: image)

# Images that depend on the term's fields or on the env.
_RULES: Mapping[type, Callable[[Any, ManagerBasedRlEnv], MirrorMap]] = {
    mdp.ImuReading: lambda term, env: _IMU[term.quantity],
    mdp.Command: lambda term, env: term_mirror(env.cfg.commands[term.command], env),
    **dict.fromkeys(
        (mdp.JointVel, mdp.JointAcc, mdp.JointEffort, mdp.JointPos, mdp.JointPosTarget),
        lambda term, env: _joints(env, term.joints),
    ),
    mdp.JointPosRel: lambda term, env: _relative_joints(env, term.joints),
    mdp.LastAction: lambda term, env: _action(env),
}
for _kind, _rule in _RULES.items():
    term_mirror.register(_kind, _rule)


@term_mirror.register
def _(term: mdp.SensorReading, env: ManagerBasedRlEnv) -> MirrorMap:
    # By the kind of sensor: vectors along (polar) or about (axial) an axis, or quaternions.
    sensor = env.view.world.mj_model.sensor(term.sensor)
    kind = mujoco.mjtSensor(int(sensor.type[0])).name.removeprefix("mjSENS_")
    if kind not in _SENSORS:
        raise ValueError(f"the mirror image of a sensor of type {kind} is not known")
    return _SENSORS[kind]


@term_mirror.register
def _(term: mdp.HeightScan, env: ManagerBasedRlEnv) -> MirrorMap:
    points_N3 = grid_points(term.size, term.resolution)
    # Rows along x, one after the other along y.
    rows = len(np.unique(points_N3[:, 1].round(6)))
    # Rows run from right to left; the mirror image has them in reverse order.
    columns = np.arange(len(points_N3)).reshape(rows, -1)[::-1].ravel()
    return MirrorMap(source=tuple(map(int, columns)))


@term_mirror.register
def _(term: JointAction, env: ManagerBasedRlEnv) -> MirrorMap:
    relative = isinstance(term, mdp.JointPositionAction) and term.use_default_offset
    if relative:
        mirror = _relative_joints(env, term.joints)
    else:
        mirror = _joints(env, term.joints)
    view = env.view
    # `source` permutes columns, `signs` turns those that move the other way.
    (source, signs) = mirror.tensors(env.view.device)
    scale = per_joint(view, "scale", term.scale, term.joints)
    if isinstance(scale, Tensor) and source is not None:
        # Left and right must be scaled alike, or an image of an action would not be an action.
        _check_symmetric("scale", scale, scale[source])
    offset = per_joint(view, "offset", term.offset, term.joints)
    # Adding 0 * signs broadcasts a single offset to all columns.
    _check_symmetric("offset", signs * 0.0 + offset, mirror(signs * 0.0 + offset))
    is_lopsided = term.clip is not None and term.clip[0] != -term.clip[1]
    # With a sign of -1 the clip's ends swap: only a symmetric one stays itself.
    if is_lopsided and bool((signs < 0).any()):
        raise ValueError(
            f"clip={term.clip} is not symmetric, and some joints turn the other way in the mirror"
        )
    # Positions and velocities of one term have the same image, one after the other.
    return concatenate([mirror] * (term.size(view) // mirror.size))


def _action(env: ManagerBasedRlEnv) -> MirrorMap:
    return concatenate(
        [_named(f"actions.{name}", term, env) for name, term in env.cfg.actions.items()]
    )


def _joints(env: ManagerBasedRlEnv, joints: Patterns) -> MirrorMap:
    return mirror_joints(env.view.world.mj_model, env.view.joints(joints).names)


def _relative_joints(env: ManagerBasedRlEnv, joints: Patterns) -> MirrorMap:
    mirror = _joints(env, joints)
    # The model's own pose: draws of events around it are as likely on either side.
    default_K = env.view.default_qpos_L[env.view.joints(joints).qpos]
    _check_symmetric("the default pose", default_K, mirror(default_K))
    return mirror


def _check_symmetric(what: str, value_K: Tensor, image_K: Tensor) -> None:
    if float((value_K - image_K).abs().max()) > _TOLERANCE:
        raise ValueError(
            f"{what} {value_K.tolist()} is not its own mirror image {image_K.tolist()}"
        )


# Bodies, feet and contacts: one number or vector for each name.
_BODIES = {
    **dict.fromkeys((mdp.BodyPos, mdp.BodyLinVel, mdp.CenterOfMassPos, mdp.CenterOfMassVel), POLAR),
    mdp.BodyAngVel: AXIAL,
    mdp.BodyQuat: QUATERNION,
}
_SITES = {mdp.FootPos: POLAR, mdp.FootHeight: None}
_CONTACTS = {
    **dict.fromkeys((mdp.Contact, mdp.FootContact, mdp.FootAirTime)),
    **dict.fromkeys((mdp.ContactForce, mdp.FootContactForces), POLAR),
}
_BY_NAME: Mapping[Any, Any] = {**_BODIES, **_SITES, **_CONTACTS}


def _of_names(term: Any, env: ManagerBasedRlEnv) -> MirrorMap:
    resolver = env.view.resolver
    # A contact sensor knows the names of its own elements.
    if isinstance(term, tuple(_CONTACTS)):
        contact = env.cfg.scene.sensors[term.sensor]
        assert isinstance(contact, ContactSensor)
        # Subtrees are named by their bodies.
        names = contact.elements(resolver.names("geom" if contact.kind == "geom" else "body"))
    else:
        is_body = isinstance(term, tuple(_BODIES))
        if is_body:
            kind = "body"
            patterns = term.bodies
        else:
            kind = "site"
            patterns = term.sites
        names = [resolver.names(kind)[i] for i in resolver.ids(kind, patterns)]
    # The first kind that fits: images of vectors are polar or axial, None keeps single numbers as they are.
    return mirror_by_name(
        names, next(image for kind, image in _BY_NAME.items() if isinstance(term, kind))
    )


for _kind in _BY_NAME:
    term_mirror.register(_kind, _of_names)
