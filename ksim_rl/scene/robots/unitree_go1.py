"""This module has Unitree Go1: the menagerie's model with reflected motor inertia, position servos, lean collisions.

Frames: the root is `trunk` (x forward, y left, z up, origin at the body frame, not at the center of mass). Legs are
FR, FL, RR, RL; each has hip (abduction, about x), thigh and calf (about y).

Sources: masses, joints and ranges: mujoco_menagerie/unitree_go1. Servo gains follow from the motor's rotor inertia
and a chosen 10 Hz, as in BeyondMimic (Liao et al., 2025) and mjlab 1.6.0, whose figures these are.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco

from ksim_rl.scene.actuators import Actuator, PositionActuator
from ksim_rl.scene.robots.edit import CollisionGeom, Site, capsule, sphere, spread
from ksim_rl.scene.robots.legged_robot import MenagerieRobot

LEGS = ("FR", "FL", "RR", "RL")
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

# Contacts with other parts of the robot are frictionless: fewer dimensions cost less.
_SMOOTH: dict[str, Any] = {"condim": 1, "solref": (0.01, 1.0)}
_FOOT: dict[str, Any] = {"condim": 6, "solref": (0.01, 1.0), "priority": 1, "friction": (1.0, 0.005, 0.0005)}


def _leg_geoms(leg: str) -> tuple[CollisionGeom, ...]:
    y = 1.0 if leg.endswith("L") else -1.0
    thigh, calf = f"{leg}_thigh", f"{leg}_calf"
    return (
        capsule(f"{leg}_hip_collision", f"{leg}_hip", 0.05, (0, 0.02 * y, 0, 0, 0.04 * y, 0), **_SMOOTH),
        capsule(f"{thigh}_collision1", thigh, 0.015, (-0.02, 0, 0, -0.02, 0, -0.16), **_SMOOTH),
        capsule(f"{thigh}_collision2", thigh, 0.015, (0, 0, 0, -0.02, 0, -0.1), **_SMOOTH),
        capsule(f"{thigh}_collision3", thigh, 0.015, (-0.02, 0, -0.16, 0, 0, -0.2), **_SMOOTH),
        capsule(f"{calf}_collision1", calf, 0.01, (0, 0, 0, 0.02, 0, -0.13), **_SMOOTH),
        capsule(f"{calf}_collision2", calf, 0.01, (0.02, 0, -0.13, 0, 0, -0.2), **_SMOOTH),
        sphere(f"{leg}_foot_collision", calf, 0.023, (0, 0, -0.213), **_FOOT),
    )


_TRUNK = CollisionGeom(
    name="trunk_collision", body="trunk", type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.13, 0.09, 0.05), **_SMOOTH
)


@dataclass(frozen=True, kw_only=True)
class UnitreeGo1(MenagerieRobot):
    """The facts of the robot, and `spec()`, the model that they describe; fields as of `MenagerieRobot`."""

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.278)
    default_joint_pos: Mapping[str, float] = field(default_factory=lambda: spread(STANCE, JOINTS))
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread(ACTION_SCALE, JOINTS))
    actuators: tuple[Actuator, ...] = SERVOS

    name: ClassVar[str] = "go1"
    root_body: ClassVar[str] = "trunk"
    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot_collision" for leg in LEGS)
    foot_sites: ClassVar[tuple[str, ...]] = LEGS
    model: ClassVar[str] = "unitree_go1/go1"
    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = (
        _TRUNK,
        sphere("head_collision", "trunk", 0.06, (0.24, 0.0, 0.0), **_SMOOTH),
        *(geom for leg in LEGS for geom in _leg_geoms(leg)),
    )
    sites: ClassVar[tuple[Site, ...]] = (Site(name="imu", body="trunk", pos=(-0.01592, -0.06659, -0.00617)),)

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh, editable model of the robot alone, whose free joint has a name."""
        spec = super().spec()
        for joint in spec.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                joint.name = "floating_base_joint"
        return spec
