"""Unitree Go2: the menagerie's model, whose legs have plain torque motors, under PD control with lean collisions.

Frames: the root is `base` (x forward, y left, z up). Legs are FR, FL, RR, RL; each has hip (abduction, about x), thigh
and calf (about y). Masses, joints, ranges and torque limits are those of mujoco_menagerie/unitree_go2; the gains are
what the robot's own low-level interface is commonly run with. Friction and damping of the joints are left to the
controller.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import mujoco

from ksim_rl.physics import load_spec
from ksim_rl.scene.actuators import Actuator, IdealPDActuator
from ksim_rl.scene.robots.edit import (
    CollisionGeom,
    Site,
    Vector,
    rebuild,
    spread,
)

LEGS = ("FR", "FL", "RR", "RL")
JOINTS = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in ("hip", "thigh", "calf"))


def _motor(joints: tuple[str, ...], effort_limit: float) -> IdealPDActuator:
    return IdealPDActuator(
        joints=joints, effort_limit=effort_limit, armature=0.01, stiffness=30.0, damping=1.0
    )


MOTORS = (_motor((".*_hip_joint", ".*_thigh_joint"), 23.7), _motor((".*_calf_joint",), 45.43))
ACTION_SCALE = {".*": 0.25}
STANCE = {"[FR]R_hip_joint": 0.1, "[FR]L_hip_joint": -0.1, ".*_thigh_joint": 0.9, ".*_calf_joint": -1.8}

_BOX, _SPHERE, _CAPSULE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
)
_CONTACT_TIME = (0.01, 1.0)
_FOOT = (-0.002, 0.0, -0.213)
"""The centre of a foot's ball in the calf's frame, m; its radius is 0.022 m."""


def _capsule(name: str, body: str, radius: float, fromto: Vector) -> CollisionGeom:
    """A capsule without friction, on the ground as well, where its priority decides: contacts then cost a quarter."""
    return CollisionGeom(
        name=name,
        body=body,
        type=_CAPSULE,
        size=(radius,),
        fromto=fromto,
        condim=1,
        priority=1,
        solref=_CONTACT_TIME,
    )


def _leg_geoms(leg: str) -> tuple[CollisionGeom, ...]:
    y = 1.0 if leg.endswith("L") else -1.0
    thigh, calf = f"{leg}_thigh", f"{leg}_calf"
    return (
        _capsule(f"{leg}_hip_collision", f"{leg}_hip", 0.046, (0.0, 0.06 * y, 0.0, 0.0, 0.1 * y, 0.0)),
        _capsule(f"{thigh}_collision", thigh, 0.017, (0.0, 0.0, -0.01, 0.0, 0.0, -0.2)),
        _capsule(f"{calf}_collision", calf, 0.012, (0.008, 0.0, -0.02, 0.02, 0.0, -0.17)),
        CollisionGeom(
            name=f"{leg}_foot_collision",
            body=calf,
            type=_SPHERE,
            size=(0.022,),
            pos=_FOOT,
            friction=(0.8, 0.02, 0.01),
            priority=1,
            solref=_CONTACT_TIME,
        ),
    )


COLLISION_GEOMS = (
    CollisionGeom(
        name="base_collision",
        body="base",
        type=_BOX,
        size=(0.1881, 0.04675, 0.057),
        condim=1,
        priority=1,
        solref=_CONTACT_TIME,
    ),
    CollisionGeom(
        name="head_collision",
        body="base",
        type=_SPHERE,
        size=(0.06,),
        pos=(0.29, 0.0, -0.02),
        condim=1,
        priority=1,
        solref=_CONTACT_TIME,
    ),
    *(geom for leg in LEGS for geom in _leg_geoms(leg)),
)
SITES = (
    Site(name="imu", body="base", pos=(-0.02557, 0.0, 0.04232)),
    *(Site(name=leg, body=f"{leg}_calf", pos=_FOOT) for leg in LEGS),
)


@dataclass(frozen=True, kw_only=True)
class UnitreeGo2:
    """The facts of the robot, and `spec()`, the model that they describe.

    Attributes:
        joint_names: the actuated joints in policy order (that of actions and joint observations).
        default_joint_pos: the stance, rad, by joint name.
        init_pos, init_quat: the root's pose in the stance: m, and a quaternion (w, x, y, z).
        action_scale: rad per unit action, by joint name.
        actuators: what drives the joints.
        soft_joint_pos_limit_factor: the part of each joint's range, about its middle, that is free of penalty.
    """

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.29)
    init_quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    default_joint_pos: Mapping[str, float] = field(default_factory=lambda: spread(STANCE, JOINTS))
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread(ACTION_SCALE, JOINTS))
    actuators: tuple[Actuator, ...] = MOTORS
    soft_joint_pos_limit_factor: float = 0.9

    name: ClassVar[str] = "go2"
    root_body: ClassVar[str] = "base"
    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot_collision" for leg in LEGS)
    foot_sites: ClassVar[tuple[str, ...]] = LEGS

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh, editable model of the robot alone, with keyframe `init_state`.

        Raises:
            ValueError: in one line, how to get the menagerie's model, if it is not at hand.
        """
        spec = load_spec("unitree_go2/go2")
        rebuild(spec, self, geoms=COLLISION_GEOMS, sites=SITES, imu="imu")
        return spec
