"""Edits of a robot's `MjSpec`: one general function per kind, fed with the facts of the robot's own file.

A robot file holds tables of the small dataclasses below; adding a robot adds tables, no code here.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco

from ksim_rl.checks import unknown_name

Vector = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class PositionServo:
    """A position controlled motor behind a gear, for all joints that match `joints`.

    The gains make the reflected inertia a second-order system of the given natural frequency and damping ratio:
    `kp = armature * w^2`, `kd = 2 * damping_ratio * armature * w`, `w = 2 pi * natural_frequency`.
    """

    joints: tuple[str, ...]
    effort_limit: float
    """N m, symmetric."""
    rotor_inertia: float
    """kg m^2, before the gear."""
    gear_ratio: float
    natural_frequency: float = 10.0
    """Hz."""
    damping_ratio: float = 2.0

    @property
    def armature(self) -> float:
        """Rotor inertia as the joint feels it, kg m^2."""
        return self.rotor_inertia * self.gear_ratio**2

    @property
    def kp(self) -> float:
        """Stiffness, N m / rad."""
        return self.armature * (2.0 * math.pi * self.natural_frequency) ** 2

    @property
    def kd(self) -> float:
        """Damping, N m s / rad."""
        return 2.0 * self.damping_ratio * self.armature * 2.0 * math.pi * self.natural_frequency


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


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """A sensor of one object, optionally relative to another."""

    name: str
    type: mujoco.mjtSensor
    objtype: mujoco.mjtObj
    objname: str
    reftype: mujoco.mjtObj = mujoco.mjtObj.mjOBJ_UNKNOWN
    refname: str = ""


def match_names(kind: str, patterns: Iterable[str], names: Sequence[str]) -> list[str]:
    """Return the names that fully match any pattern, in the order of `names`.

    Raises:
        ValueError: if a pattern matches nothing, with the near names.
    """
    patterns = tuple(patterns)
    for pattern in patterns:
        if not any(re.fullmatch(pattern, name) for name in names):
            raise unknown_name(kind, pattern, names)
    return [name for name in names if any(re.fullmatch(pattern, name) for pattern in patterns)]


def reset_options(spec: mujoco.MjSpec) -> None:
    """Give the physics options back to MuJoCo's defaults: a task's `SimCfg` decides them, not the robot's file."""
    spec.option = mujoco.MjSpec().option


def set_passive_joints(spec: mujoco.MjSpec, *, damping: float = 0.0, frictionloss: float = 0.0) -> None:
    """Set damping and dry friction of every joint with one degree of freedom."""
    for joint in _single_dof_joints(spec):
        joint.damping = [damping, 0.0, 0.0]
        joint.frictionloss = frictionloss


def set_position_actuators(spec: mujoco.MjSpec, servos: Sequence[PositionServo]) -> None:
    """Replace all actuators by one position servo per joint, named as its joint, in the order of `servos`.

    The control range is what can still change the force at a joint limit, and does not clip: a clipped target
    would hide from the policy what it asked for.
    """
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    joints = {joint.name: joint for joint in _single_dof_joints(spec)}
    for servo in servos:
        reach = servo.effort_limit / servo.kp
        for name in match_names("joint", servo.joints, list(joints)):
            joint = joints[name]
            joint.armature = servo.armature
            actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=servo.kp, kv=servo.kd)
            actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.forcerange = [-servo.effort_limit, servo.effort_limit]
            actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
            actuator.ctrlrange = [joint.range[0] - reach, joint.range[1] + reach]


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


def add_sensors(spec: mujoco.MjSpec, sensors: Iterable[Sensor]) -> None:
    """Append sensors."""
    for sensor in sensors:
        spec.add_sensor(
            name=sensor.name,
            type=sensor.type,
            objtype=sensor.objtype,
            objname=sensor.objname,
            reftype=sensor.reftype,
            refname=sensor.refname,
        )


def set_keyframe(
    spec: mujoco.MjSpec,
    name: str,
    *,
    init_pos: Vector,
    init_quat: Vector,
    joint_pos: Mapping[str, float],
) -> None:
    """Replace all keyframes by one: the root pose, `joint_pos`, and controls that hold those joints.

    Needs a robot whose first joint is free and whose other joints all have one degree of freedom.
    """
    for key in list(spec.keys):
        spec.delete(key)
    qpos = [*init_pos, *init_quat, *(joint_pos[joint.name] for joint in _single_dof_joints(spec))]
    spec.add_key(name=name, qpos=qpos, ctrl=[joint_pos[actuator.target] for actuator in spec.actuators])


def _single_dof_joints(spec: mujoco.MjSpec) -> list[mujoco.MjsJoint]:
    kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    return [joint for joint in spec.joints if joint.type in kinds]
