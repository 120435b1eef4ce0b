"""This module edits a robot's `MjSpec`: one general function per kind, fed with the facts of the robot's own file.

A robot file holds tables of the small dataclasses below; adding a robot adds tables, no code here.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import mujoco

from ksim_rl.checks import unknown_name
from ksim_rl.scene.actuators import Actuator, set_actuators
from ksim_rl.scene.names import match_names
from ksim_rl.scene.state.joint_targets import control_kind

Vector = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class CollisionGeom:
    """A primitive that collides. Fields mean what MJCF's `geom` attributes mean, with MuJoCo's own defaults."""

    name: str
    body: str
    type: mujoco.mjtGeom
    size: Vector
    pos: Vector = (0.0, 0.0, 0.0)
    fromto: Vector | None = None
    """The two ends of a capsule or cylinder, in place of `pos`."""
    friction: Vector = (1.0, 0.005, 0.0001)
    condim: int = 3
    priority: int = 0
    solref: Vector = (0.02, 1.0)
    solimp: Vector = (0.9, 0.95, 0.001, 0.5, 2.0)
    margin: float = 0.0
    group: int = 3


def capsule(name: str, body: str, radius: float, fromto: Vector, **attributes: Any) -> CollisionGeom:
    """Return a capsule between two points; `attributes` are fields of `CollisionGeom`."""
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    return CollisionGeom(name=name, body=body, type=kind, size=(radius,), fromto=fromto, **attributes)


def sphere(name: str, body: str, radius: float, pos: Vector, **attributes: Any) -> CollisionGeom:
    """Return a sphere; `attributes` are fields of `CollisionGeom`."""
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    return CollisionGeom(name=name, body=body, type=kind, size=(radius,), pos=pos, **attributes)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A sensor of one object, optionally relative to another."""

    name: str
    type: mujoco.mjtSensor
    objtype: mujoco.mjtObj
    objname: str
    reftype: mujoco.mjtObj = mujoco.mjtObj.mjOBJ_UNKNOWN
    refname: str = ""


@dataclass(frozen=True, kw_only=True)
class Site:
    """A named point of a body, m in its frame; `radius` is for drawing."""

    name: str
    body: str
    pos: Vector = (0.0, 0.0, 0.0)
    radius: float = 0.005


class RobotFacts(Protocol):
    """The facts of a robot that `rebuild` puts into its model."""

    root_body: ClassVar[str]

    @property
    def actuators(self) -> Sequence[Actuator]:
        """What drives the joints."""
        ...

    @property
    def init_pos(self) -> Vector:
        """Position of the root in the default pose, m."""
        ...

    @property
    def init_quat(self) -> Vector:
        """Orientation of the root in the default pose, (w, x, y, z)."""
        ...

    @property
    def default_joint_pos(self) -> Mapping[str, float]:
        """The default pose, rad or m by joint name."""
        ...


def rebuild(
    spec: mujoco.MjSpec,
    robot: RobotFacts,
    *,
    geoms: Sequence[CollisionGeom],
    sites: Sequence[Site],
    imu: str,
) -> None:
    """Turn the menagerie's model of a legged robot into that of its facts.

    Options, actuators, collision geoms, sensors (`root_sensors`) and keyframes (one, `init_state`) are replaced, sites
    moved and added, and the joints' own damping and friction removed; bodies, joints and visual geoms stay.

    Args:
        imu: the site of the IMU, one of the model or of `sites`.
    """
    reset_options(spec)
    set_passive_joints(spec)
    set_actuators(spec, robot.actuators)
    replace_collision_geoms(spec, geoms)
    set_sites(spec, sites)
    replace_sensors(spec, root_sensors(imu=imu, root=robot.root_body))
    set_keyframe(
        spec,
        "init_state",
        init_pos=robot.init_pos,
        init_quat=robot.init_quat,
        joint_pos=robot.default_joint_pos,
    )


def reflected_inertia(inertias: Sequence[float], ratios: Sequence[float]) -> float:
    """Return what a joint feels of a gear train, kg m^2.

    Args:
        inertias: of the rotor and of what turns with each stage's output, kg m^2.
        ratios: of the stages, one fewer than inertias.
    """
    total = 0.0
    for inertia, ratio in zip(inertias, (*ratios, 1.0), strict=True):
        total = (total + inertia) * ratio**2
    return total


def spread(
    table: Mapping[str, float], names: Sequence[str], *, default: float | None = None
) -> dict[str, float]:
    """Return one value per name: that of the pattern in `table` that fully matches it, else `default`.

    Raises:
        ValueError: if a name matches several patterns, or none and there is no default, or a pattern matches no name.
    """
    owners = {pattern: match_names("name", (pattern,), names) for pattern in table}
    values = {}
    for index, name in enumerate(names):
        found = [table[pattern] for pattern, matches in owners.items() if index in matches]
        if len(found) > 1 or (not found and default is None):
            raise ValueError(f"{name!r} matches {len(found)} of the patterns {list(table)}: expected one")
        values[name] = found[0] if found else default
    return values


def root_sensors(*, imu: str, root: str) -> tuple[Sensor, ...]:
    """Return what walking tasks read: an IMU at a site, and the angular momentum of all that hangs on the root."""
    site, body = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY
    kinds = mujoco.mjtSensor
    return (
        Sensor(name="imu_ang_vel", type=kinds.mjSENS_GYRO, objtype=site, objname=imu),
        Sensor(name="imu_lin_vel", type=kinds.mjSENS_VELOCIMETER, objtype=site, objname=imu),
        Sensor(name="imu_lin_acc", type=kinds.mjSENS_ACCELEROMETER, objtype=site, objname=imu),
        Sensor(
            name="imu_upvector",
            type=kinds.mjSENS_FRAMEZAXIS,
            objtype=body,
            objname="world",
            reftype=site,
            refname=imu,
        ),
        Sensor(name="root_angmom", type=kinds.mjSENS_SUBTREEANGMOM, objtype=body, objname=root),
    )


def reset_options(spec: mujoco.MjSpec) -> None:
    """Give the physics options back to MuJoCo's defaults: a task's `SimCfg` decides them, not the robot's file."""
    spec.option = mujoco.MjSpec().option


def set_passive_joints(spec: mujoco.MjSpec, *, damping: float = 0.0, frictionloss: float = 0.0) -> None:
    """Set damping and dry friction of every joint with one degree of freedom."""
    for joint in _single_dof_joints(spec):
        joint.damping = [damping, 0.0, 0.0]
        joint.frictionloss = frictionloss


def replace_collision_geoms(spec: mujoco.MjSpec, geoms: Sequence[CollisionGeom]) -> None:
    """Delete every geom that can collide and add `geoms`. Visual geoms stay."""
    for geom in list(spec.geoms):
        if geom.contype or geom.conaffinity:
            spec.delete(geom)
    bodies = {body.name: body for body in spec.bodies}
    for geom in geoms:
        if geom.body not in bodies:
            raise unknown_name("body", geom.body, bodies)
        # Each attribute is written: the body's default class may hold others.
        placed = bodies[geom.body].add_geom(
            name=geom.name,
            type=geom.type,
            size=[*geom.size, 0.0, 0.0, 0.0][:3],
            pos=geom.pos,
            friction=geom.friction,
            condim=geom.condim,
            priority=geom.priority,
            solref=geom.solref,
            solimp=geom.solimp,
            margin=geom.margin,
            contype=1,
            conaffinity=1,
            group=geom.group,
        )
        if geom.fromto is not None:
            placed.fromto = geom.fromto


def replace_sensors(spec: mujoco.MjSpec, sensors: Iterable[Sensor]) -> None:
    """Delete every sensor and add `sensors`."""
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for sensor in sensors:
        spec.add_sensor(
            name=sensor.name,
            type=sensor.type,
            objtype=sensor.objtype,
            objname=sensor.objname,
            reftype=sensor.reftype,
            refname=sensor.refname,
        )


def set_sites(spec: mujoco.MjSpec, sites: Iterable[Site], *, group: int = 5) -> None:
    """Move the sites that exist and add the others."""
    present = {site.name: site for site in spec.sites}
    bodies = {body.name: body for body in spec.bodies}
    for site in sites:
        if site.body not in bodies:
            raise unknown_name("body", site.body, bodies)
        placed = present.get(site.name) or bodies[site.body].add_site(name=site.name)
        placed.pos, placed.size, placed.group = site.pos, [site.radius] * 3, group


def exclude_contacts(spec: mujoco.MjSpec, pairs: Iterable[tuple[str, str]]) -> None:
    """Let pairs of bodies pass through each other."""
    for first, second in pairs:
        spec.add_exclude(bodyname1=first, bodyname2=second)


def set_keyframe(
    spec: mujoco.MjSpec,
    name: str,
    *,
    init_pos: Vector,
    init_quat: Vector,
    joint_pos: Mapping[str, float],
) -> None:
    """Replace all keyframes by one: the root pose, `joint_pos`, and the controls of servos that hold those joints.

    Needs a robot whose first joint is free and whose other joints all have one degree of freedom.
    """
    for key in list(spec.keys):
        spec.delete(key)
    qpos = [*init_pos, *init_quat, *(joint_pos[joint.name] for joint in _single_dof_joints(spec))]
    ctrl = [
        joint_pos[a.target] if control_kind(a.biastype, a.biasprm, a.dyntype) == "pos" else 0.0
        for a in spec.actuators
    ]
    spec.add_key(name=name, qpos=qpos, ctrl=ctrl)


def _single_dof_joints(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return [joint for joint in spec.joints if joint.type in kinds]
