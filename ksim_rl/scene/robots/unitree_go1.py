"""Unitree Go1: the menagerie's model with reflected motor inertia, position servos and a lean collision set.

Frames: the root is `trunk` (x forward, y left, z up, origin at the body frame, not at the center of mass). Legs are
FR, FL, RR, RL; each has hip (abduction, about x), thigh and calf (about y).

Sources: masses, joints and ranges: mujoco_menagerie/unitree_go1. Servo gains follow from the motor's rotor inertia
and a chosen 10 Hz, as in BeyondMimic (Liao et al., 2025) and mjlab 1.6.0, whose figures these are.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import mujoco

from ksim_rl.physics import load_spec
from ksim_rl.scene.actuators import Actuator, PositionActuator
from ksim_rl.scene.robots.edit import (
    CollisionGeom,
    Site,
    rebuild,
    spread,
)

LEGS = ("FR", "FL", "RR", "RL")
_SIDE = {"FR": -1.0, "FL": 1.0, "RR": -1.0, "RL": 1.0}
JOINTS = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in ("hip", "thigh", "calf"))

ROTOR_INERTIA = 0.000111842
"""kg m^2 of one motor; the reduction is 6, and another 1.5 at the calf's linkage."""

SERVOS = (
    PositionActuator.tuned(
        joints=(".*_hip_joint", ".*_thigh_joint"),
        effort_limit=23.7,
        armature=ROTOR_INERTIA * 6.0**2,
    ),
    PositionActuator.tuned(
        joints=(".*_calf_joint",),
        effort_limit=35.55,
        armature=ROTOR_INERTIA * (6.0 * 1.5) ** 2,
    ),
)
# A unit action moves the target by a quarter of the deflection at which the servo saturates (effort_limit / kp).
ACTION_SCALE = {".*_(hip|thigh)_joint": 0.37275, ".*_calf_joint": 0.2485}
STANCE = {"[FR]R_hip_joint": 0.1, "[FR]L_hip_joint": -0.1, ".*_thigh_joint": 0.9, ".*_calf_joint": -1.8}

_CONTACT_TIME = (0.01, 1.0)
_BOX, _SPHERE, _CAPSULE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
)
IMU = Site(name="imu", body="trunk", pos=(-0.01592, -0.06659, -0.00617))


def _capsule(name: str, body: str, radius: float, fromto: tuple[float, ...]) -> CollisionGeom:
    """A capsule whose contacts with other parts of the robot are frictionless: fewer dimensions cost less."""
    return CollisionGeom(
        name=name, body=body, type=_CAPSULE, size=(radius,), fromto=fromto, condim=1, solref=_CONTACT_TIME
    )


def _leg_geoms(leg: str) -> tuple[CollisionGeom, ...]:
    y = _SIDE[leg]
    thigh, calf = f"{leg}_thigh", f"{leg}_calf"
    return (
        _capsule(f"{leg}_hip_collision", f"{leg}_hip", 0.05, (0.0, 0.02 * y, 0.0, 0.0, 0.04 * y, 0.0)),
        _capsule(f"{thigh}_collision1", thigh, 0.015, (-0.02, 0.0, 0.0, -0.02, 0.0, -0.16)),
        _capsule(f"{thigh}_collision2", thigh, 0.015, (0.0, 0.0, 0.0, -0.02, 0.0, -0.1)),
        _capsule(f"{thigh}_collision3", thigh, 0.015, (-0.02, 0.0, -0.16, 0.0, 0.0, -0.2)),
        _capsule(f"{calf}_collision1", calf, 0.01, (0.0, 0.0, 0.0, 0.02, 0.0, -0.13)),
        _capsule(f"{calf}_collision2", calf, 0.01, (0.02, 0.0, -0.13, 0.0, 0.0, -0.2)),
        CollisionGeom(
            name=f"{leg}_foot_collision",
            body=calf,
            type=_SPHERE,
            size=(0.023,),
            pos=(0.0, 0.0, -0.213),
            friction=(1.0, 0.005, 0.0005),
            condim=6,
            priority=1,
            solref=_CONTACT_TIME,
        ),
    )


COLLISION_GEOMS = (
    CollisionGeom(
        name="trunk_collision",
        body="trunk",
        type=_BOX,
        size=(0.13, 0.09, 0.05),
        condim=1,
        solref=_CONTACT_TIME,
    ),
    CollisionGeom(
        name="head_collision",
        body="trunk",
        type=_SPHERE,
        size=(0.06,),
        pos=(0.24, 0.0, 0.0),
        condim=1,
        solref=_CONTACT_TIME,
    ),
    *(geom for leg in LEGS for geom in _leg_geoms(leg)),
)


@dataclass(frozen=True, kw_only=True)
class UnitreeGo1:
    """The facts of the robot, and `spec()`, the model that they describe.

    Attributes:
        joint_names: the actuated joints in policy order (that of actions and joint observations).
        default_joint_pos: the stance, rad, by joint name.
        init_pos, init_quat: the root's pose in the stance: m, and a quaternion (w, x, y, z).
        action_scale: rad per unit action, by joint name.
        actuators: what drives the joints.
        soft_joint_pos_limit_factor: the part of each joint's range, about its middle, that is free of penalty.
    """

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.278)
    init_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    default_joint_pos: Mapping[str, float] = field(default_factory=lambda: spread(STANCE, JOINTS))
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread(ACTION_SCALE, JOINTS))
    actuators: tuple[Actuator, ...] = SERVOS
    soft_joint_pos_limit_factor: float = 0.9

    name: ClassVar[str] = "go1"
    root_body: ClassVar[str] = "trunk"
    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot_collision" for leg in LEGS)
    foot_sites: ClassVar[tuple[str, ...]] = LEGS

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh, editable model of the robot alone, with keyframe `init_state`.

        Raises:
            ValueError: in one line, how to get the menagerie's model, if it is not at hand.
        """
        spec = load_spec("unitree_go1/go1")
        for joint in spec.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                joint.name = "floating_base_joint"
        rebuild(spec, self, geoms=COLLISION_GEOMS, sites=(IMU,), imu="imu")
        return spec
