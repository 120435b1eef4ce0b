"""Edits a robot's `MjSpec`: one general function per kind, fed with the tables of the robot's own file."""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypedDict, Unpack

import mujoco
import numpy as np

from ksim_rl.checks import check_known
from ksim_rl.physics.load import caught_warnings
from ksim_rl.scene.actuators.actuator import Actuator
from ksim_rl.scene.actuators.joint_drives import driven_joints
from ksim_rl.scene.names import SCALAR_JOINTS, TO_JOINTS, match_names
from ksim_rl.scene.state.joint_control import control_of_spec

Vector = tuple[float, ...]
BALL_AT_REST = (1.0, 0.0, 0.0, 0.0)
VISIBLE = 2
"""The group of robots' visual geoms; those up to it are shown by custom."""


class GeomAttributes(TypedDict, total=False):
    """Fields of `CollisionGeom` that several geoms may share."""

    quat: Vector
    friction: Vector
    condim: int
    priority: int
    solref: Vector
    solimp: Vector
    margin: float
    group: int


@dataclass(frozen=True, kw_only=True)
class CollisionGeom:
    """A primitive that collides and weighs nothing; fields are MJCF's `geom` attributes, with MuJoCo's defaults."""

    name: str
    body: str
    type: int
    """One of `mujoco.mjtGeom`."""
    size: Vector
    pos: Vector = (0.0, 0.0, 0.0)
    quat: Vector = (1.0, 0.0, 0.0, 0.0)
    fromto: Vector | None = None
    """The two ends of a capsule or cylinder, in place of `pos` and `quat`."""
    # MuJoCo's own defaults, since a body's default class may have others.
    friction: Vector = (1.0, 0.005, 0.0001)
    condim: int = 3
    priority: int = 0
    solref: Vector = (0.02, 1.0)
    solimp: Vector = (0.9, 0.95, 0.001, 0.5, 2.0)
    margin: float = 0.0
    # Group 3 is hidden in viewers by custom: collision geoms are not for show.
    group: int = 3

    def __rich_repr__(self) -> Iterator[tuple[str, Any, Any]]:
        """Yield name, value and default of each field, so that code shows what differs."""
        # Without `field.default` each geom would be printed in full.
        yield from (
            (field.name, getattr(self, field.name), field.default) for field in fields(self)
        )

    def __post_init__(self) -> None:
        object.__setattr__(self, "type", int(self.type))  # so that it can stand in a config file
        is_placed = any(self.pos) or tuple(self.quat) != (1.0, 0.0, 0.0, 0.0)
        if self.fromto is not None and is_placed:
            raise ValueError(
                f"geom {self.name!r}: fromto={self.fromto} with pos={self.pos}, quat={self.quat}: give fromto alone, "
                "or pos and quat with half the length in size"
            )


def capsule(
    name: str, body: str, radius: float, fromto: Vector, **attributes: Unpack[GeomAttributes]
) -> CollisionGeom:
    """Return a capsule between two points; `attributes` are fields of `CollisionGeom`."""
    kind = mujoco.mjtGeom.mjGEOM_CAPSULE
    return CollisionGeom(
        name=name, body=body, type=kind, size=(radius,), fromto=fromto, **attributes
    )


def sphere(
    name: str, body: str, radius: float, pos: Vector, **attributes: Unpack[GeomAttributes]
) -> CollisionGeom:
    """Return a sphere; `attributes` are fields of `CollisionGeom`."""
    kind = mujoco.mjtGeom.mjGEOM_SPHERE
    return CollisionGeom(name=name, body=body, type=kind, size=(radius,), pos=pos, **attributes)


def box(
    name: str, body: str, half_edges: Vector, **attributes: Unpack[GeomAttributes]
) -> CollisionGeom:
    """Return a box about the body's origin; `attributes` are fields of `CollisionGeom`."""
    return CollisionGeom(
        name=name, body=body, type=mujoco.mjtGeom.mjGEOM_BOX, size=half_edges, **attributes
    )


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


def reflected_inertia(inertias: Sequence[float], ratios: Sequence[float]) -> float:
    """Return the inertia of a gear train at its joint, kg m^2: of its rotor, and of each stage's output."""
    total = 0.0
    # From the rotor outwards: inertia before a stage counts by the square of its ratio; the output has no
    # stage after it.
    for inertia, ratio in zip(inertias, (*ratios, 1.0), strict=True):
        total = (total + inertia) * ratio**2
    return total


def spread(
    table: Mapping[str, float], names: Sequence[str], *, default: float | None = None
) -> dict[str, float]:
    """Return one value per name: from the one pattern in `table` that fully matches it, else `default`."""
    owners = {pattern: match_names("name", (pattern,), names) for pattern in table}
    values = {}
    for index, name in enumerate(names):
        found = [table[pattern] for pattern, matches in owners.items() if index in matches]
        # Two matches would make the value depend on the table's order.
        if len(found) > 1 or (not found and default is None):
            if found:
                hint = ""
            else:
                hint = ", or a default=, as in spread(table, names, default=0.0)"
            raise ValueError(
                f"{name!r} matches {len(found)} of the patterns {list(table)}: expected one{hint}"
            )
        values[name] = found[0] if found else default
    return values


def root_sensors(*, imu: str, root: str) -> tuple[Sensor, ...]:
    """Return the sensors that walking tasks read: an IMU at a site, and the angular momentum of the root's subtree."""
    site = mujoco.mjtObj.mjOBJ_SITE
    body = mujoco.mjtObj.mjOBJ_BODY
    kinds = mujoco.mjtSensor
    at_imu = {
        "imu_ang_vel": kinds.mjSENS_GYRO,
        "imu_lin_vel": kinds.mjSENS_VELOCIMETER,
        "imu_lin_acc": kinds.mjSENS_ACCELEROMETER,
    }
    # World z in the axes of the IMU's site: which way is up.
    up: dict[str, Any] = {"objtype": body, "objname": "world", "reftype": site, "refname": imu}
    return (
        *(Sensor(name=name, type=kind, objtype=site, objname=imu) for name, kind in at_imu.items()),
        Sensor(name="imu_upvector", type=kinds.mjSENS_FRAMEZAXIS, **up),
        Sensor(name="root_angmom", type=kinds.mjSENS_SUBTREEANGMOM, objtype=body, objname=root),
    )


def reset_options(spec: mujoco.MjSpec) -> None:
    """Give the physics options back to MuJoCo's defaults: a task's `SimCfg` decides them, not the robot's file."""
    spec.option = mujoco.MjSpec().option


def clear_joint_losses(spec: mujoco.MjSpec, actuators: Sequence[Actuator]) -> None:
    """Take damping and dry friction from every joint that an actuator drives; passive joints keep theirs."""
    joints = {joint.name: joint for joint in _single_dof_joints(spec)}
    # Losses are the business of the new actuators, which bring their own.
    for _, names in driven_joints(actuators, list(joints)):
        for name in names:
            joints[name].damping = [0.0, 0.0, 0.0]
            joints[name].frictionloss = 0.0


def drop_other_actuators(spec: mujoco.MjSpec, actuators: Sequence[Actuator]) -> None:
    """Delete the model's actuators that none of `actuators` replaces: of tendons, sites, bodies and other joints."""
    joints = [joint.name for joint in _single_dof_joints(spec)]
    # Actuators of driven joints stay for now: `set_actuators` replaces them and keeps their sensors.
    replaced = {name for _, names in driven_joints(actuators, joints) for name in names}
    for actuator in list(spec.actuators):
        if actuator.trntype not in TO_JOINTS or actuator.target not in replaced:
            # Sensors of a deleted actuator would keep the spec from compiling.
            drop_references(spec, mujoco.mjtObj.mjOBJ_ACTUATOR, {actuator.name})
            spec.delete(actuator)


def drop_references(spec: mujoco.MjSpec, kind: mujoco.mjtObj, names: Collection[str]) -> None:
    """Delete the sensors of elements that go, and the custom tuples that name them."""
    for sensor in list(spec.sensors):
        if (sensor.objtype == kind and sensor.objname in names) or (
            sensor.reftype == kind and sensor.refname in names
        ):
            spec.delete(sensor)
    for entry in list(spec.tuples):
        named = zip(entry.objtype, entry.objname, strict=True)
        if any(objtype == kind and objname in names for objtype, objname in named):
            spec.delete(entry)


def drop_bodies(spec: mujoco.MjSpec, names: Iterable[str]) -> None:
    """Delete bodies with all that hangs on them or refers to them; keyframes keep the columns of the other joints."""
    for name in names:
        check_known("body", name, [body.name for body in spec.bodies])
        # MuJoCo deletes sensors, actuators, tendons, pairs and equalities along, and columns of keyframes.
        spec.delete(spec.body(name))


def replace_collision_geoms(spec: mujoco.MjSpec, geoms: Sequence[CollisionGeom]) -> None:
    """Delete all geoms that can collide and add `geoms`; visual geoms, masses and inertias of all bodies stay.

    Geoms that a tendon wraps around stay too, and collide no more, as do the geoms of bodies that would be invisible
    without them; these lose their names. Explicit pairs of geoms are contacts of the old ones, and go with them, as
    sensors of the old ones do.
    """
    bodies = {body.name: body for body in spec.bodies}
    for geom in geoms:
        check_known("body", geom.body, bodies)
    colliding = [geom for geom in spec.geoms if geom.contype or geom.conaffinity]
    # Before deleting: inertia may be inferred from the geoms that go.
    _keep_inertia(spec, [geom.parent for geom in colliding])
    for pair in list(spec.pairs):
        spec.delete(pair)
    # Tendons would not compile without the geoms that they wrap around.
    wrapped = _wrapped_geoms(spec)
    deleted = {geom.name for geom in colliding if geom.name not in wrapped}
    # Geoms without names have no references.
    drop_references(spec, mujoco.mjtObj.mjOBJ_GEOM, deleted - {""})
    # The world counts as seen: its colliding geoms are ground and props, which a scene has of its own.
    looks = {spec.worldbody.name}
    looks |= {
        geom.parent.name for geom in spec.geoms if geom not in colliding and geom.group <= VISIBLE
    }
    for geom in colliding:
        if geom.name in wrapped:
            geom.contype = geom.conaffinity = 0
        elif geom.group <= VISIBLE and geom.parent.name not in looks:
            # Files without visual geoms show what collides; a new geom may want the name.
            geom.name = ""
            geom.group = VISIBLE
            geom.contype = geom.conaffinity = 0
        else:
            spec.delete(geom)
    for geom in geoms:
        # Each attribute is written: the body's default class may hold others.
        attributes = {
            name: value for name, value in vars(geom).items() if name not in ("body", "fromto")
        }
        # MuJoCo wants three sizes, whatever the kind.
        attributes["size"] = [*geom.size, 0.0, 0.0, 0.0][:3]
        # Without mass: the body's inertia is written down already.
        placed = bodies[geom.body].add_geom(contype=1, conaffinity=1, mass=0.0, **attributes)
        if geom.fromto is not None:
            placed.fromto = geom.fromto


def _wrapped_geoms(spec: mujoco.MjSpec) -> set[str]:
    """Return the names of geoms that tendons wrap around."""
    around = (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)
    return {
        path.target.name for tendon in spec.tendons for path in tendon.path if path.type in around
    }


def _keep_inertia(spec: mujoco.MjSpec, bodies: Sequence[mujoco.MjsBody]) -> None:
    """Write down the inertia of the bodies that have it from their geoms."""
    from_geoms = spec.compiler.inertiafromgeom
    if not bodies or from_geoms == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE:
        return
    # Then explicit inertias are ignored, also for bodies whose geoms stay.
    all_inferred = from_geoms == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    # Without the world, whose inertia plays no part.
    present = list(spec.bodies)[1:]
    inferred = [all_inferred or (body in bodies and not body.explicitinertial) for body in present]
    if not any(inferred):
        return
    mj_model = compiled_bodies(spec)
    # Otherwise the compiler would infer inertia from the new geoms.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for number, (body, is_inferred) in enumerate(zip(present, inferred, strict=True), 1):
        # A body without mass cannot have an explicit inertia.
        if is_inferred and mj_model.body_mass[number] > 0.0:
            ipos = mj_model.body_ipos[number]
            iquat = mj_model.body_iquat[number]
            write_inertia(body, mj_model, number, ipos=ipos, iquat=iquat)


def compiled_bodies(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the compiled model of a spec with each of its bodies, in the spec's order, and the masses it writes."""
    twin = spec.copy()
    # Fused bodies have no inertia of their own, and the compiler scales the masses written down from here once more.
    twin.compiler.fusestatic = False
    twin.compiler.settotalmass = -1
    with caught_warnings():
        return twin.compile()


def write_inertia(
    body: mujoco.MjsBody,
    mj_model: mujoco.MjModel,
    number: int,
    *,
    ipos: np.ndarray,
    iquat: np.ndarray,
) -> None:
    """Write down a body's mass and principal inertia, from body `number`; the axes lie at `ipos` (m), `iquat`."""
    body.explicitinertial = True
    body.mass = mj_model.body_mass[number]
    body.inertia = mj_model.body_inertia[number]
    # Either of these would be read instead.
    body.fullinertia = [math.nan] + [0.0] * 5
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    body.ipos = ipos
    body.iquat = iquat


def replace_sensors(spec: mujoco.MjSpec, sensors: Iterable[Sensor]) -> None:
    """Delete every sensor and add `sensors`."""
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for sensor in sensors:
        spec.add_sensor(**vars(sensor))


def set_sites(spec: mujoco.MjSpec, sites: Iterable[Site]) -> None:
    """Move the sites that exist, to another body too (whose axes they then have), and add the others."""
    present = {site.name: site for site in spec.sites}
    bodies = {body.name: body for body in spec.bodies}
    for site in sites:
        check_known("body", site.body, bodies)
        # Sites cannot change their parent: delete, and add again below.
        placed = present.get(site.name)
        if placed is not None and placed.parent != bodies[site.body]:
            spec.delete(placed)
            placed = None
        placed = placed or bodies[site.body].add_site(name=site.name)
        placed.pos = site.pos
        placed.size = [site.radius] * 3
        # Hidden in viewers by default.
        placed.group = 5


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

    Needs a robot whose only free joint is its root's; balls stand as the model has them.
    """
    for key in list(spec.keys):
        spec.delete(key)
    # In the order of the joints, which is the order of qpos.
    qpos: list[float] = []
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            qpos += [*init_pos, *init_quat]
        elif joint.type == mujoco.mjtJoint.mjJNT_BALL:
            qpos += BALL_AT_REST
        else:
            qpos.append(joint_pos[joint.name])
    ctrl: list[float] = []
    for actuator in spec.actuators:
        control = control_of_spec(actuator)
        drives_joint = actuator.trntype in TO_JOINTS and actuator.target in joint_pos
        # Only position servos hold a joint; a motor's control of 0 exerts nothing.
        holds = drives_joint and control.kind == "pos" and not control.refusal
        ctrl.append(control.of(joint_pos[actuator.target]) if holds else 0.0)
    spec.add_key(name=name, qpos=qpos, ctrl=ctrl)


def _single_dof_joints(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    return [joint for joint in spec.joints if joint.type in SCALAR_JOINTS]
