"""Unitree's quadrupeds: the menagerie's models with position servos or PD motors, and lean collisions.

Frames: the root is `trunk` (Go1) or `base` (Go2): x forward, y left, z up, origin at the body frame, not at the center
of mass. Legs are FR, FL, RR, RL; each has hip (abduction, about x), thigh and calf (about y). Masses, joints, ranges
and Go2's torque limits are from mujoco_menagerie; friction and damping of the joints are left to the motors.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import mujoco

from ksim_rl.scene.actuators import Actuator, IdealPDActuator, PositionActuator
from ksim_rl.scene.robots.edit import (
    CollisionGeom,
    GeomAttributes,
    Site,
    box,
    capsule,
    sphere,
    spread,
)
from ksim_rl.scene.robots.legged_robot import MenagerieRobot

LEGS = ("FR", "FL", "RR", "RL")
JOINTS = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in ("hip", "thigh", "calf"))
STANCE = {
    "[FR]R_hip_joint": 0.1,
    "[FR]L_hip_joint": -0.1,
    ".*_thigh_joint": 0.9,
    ".*_calf_joint": -1.8,
}
_LIGHT_JOINTS = (".*_hip_joint", ".*_thigh_joint")
_CALF_JOINTS = (".*_calf_joint",)
# Contacts with other parts of the robot are frictionless: fewer dimensions cost less. Go2's priority makes those with
# the ground frictionless too, which cost a quarter then.
_GO1_SMOOTH: GeomAttributes = {"condim": 1, "solref": (0.01, 1.0)}
_GO2_SMOOTH: GeomAttributes = _GO1_SMOOTH | {"priority": 1}


@dataclass(frozen=True, kw_only=True)
class UnitreeQuadruped(MenagerieRobot):
    """The base of Go1 and Go2; fields as of `MenagerieRobot`."""

    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    foot_sites: ClassVar[tuple[str, ...]] = LEGS

    default_joint_pos: Mapping[str, float] = field(default_factory=lambda: spread(STANCE, JOINTS))

    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot_collision" for leg in LEGS)


ROTOR_INERTIA = 0.000111842
"""kg m^2 of one motor of Go1; the reduction is 6, and another 1.5 at the calf's linkage."""

# Gains follow from the motor's inertia and a chosen 10 Hz, as in BeyondMimic (Liao et al., 2025) and mjlab 1.6.0, whose
# figures these are.
GO1_SERVOS = (
    PositionActuator.tuned(
        joints=_LIGHT_JOINTS, effort_limit=23.7, armature=ROTOR_INERTIA * 6.0**2
    ),
    PositionActuator.tuned(
        joints=_CALF_JOINTS, effort_limit=35.55, armature=ROTOR_INERTIA * (6.0 * 1.5) ** 2
    ),
)
# A unit action moves the target by a quarter of the deflection at which the servo saturates (effort_limit / kp).
# Keys match all four legs.
GO1_ACTION_SCALE = {".*_(hip|thigh)_joint": 0.37275, ".*_calf_joint": 0.2485}
# Six dimensions: feet also resist spinning and rolling; their priority decides on any ground.
_GO1_FOOT: GeomAttributes = {
    "condim": 6,
    "solref": (0.01, 1.0),
    "priority": 1,
    "friction": (1.0, 0.005, 0.0005),
}


def _go1_leg_geoms(leg: str) -> tuple[CollisionGeom, ...]:
    # The y axis points left, so that offsets to the side change sign with it.
    y = 1.0 if leg.endswith("L") else -1.0
    thigh = f"{leg}_thigh"
    calf = f"{leg}_calf"
    # The thigh bends backwards: three capsules follow its shape.
    return (
        capsule(
            f"{leg}_hip_collision",
            f"{leg}_hip",
            0.05,
            (0, 0.02 * y, 0, 0, 0.04 * y, 0),
            **_GO1_SMOOTH,
        ),
        capsule(f"{thigh}_collision1", thigh, 0.015, (-0.02, 0, 0, -0.02, 0, -0.16), **_GO1_SMOOTH),
        capsule(f"{thigh}_collision2", thigh, 0.015, (0, 0, 0, -0.02, 0, -0.1), **_GO1_SMOOTH),
        capsule(f"{thigh}_collision3", thigh, 0.015, (-0.02, 0, -0.16, 0, 0, -0.2), **_GO1_SMOOTH),
        capsule(f"{calf}_collision1", calf, 0.01, (0, 0, 0, 0.02, 0, -0.13), **_GO1_SMOOTH),
        capsule(f"{calf}_collision2", calf, 0.01, (0.02, 0, -0.13, 0, 0, -0.2), **_GO1_SMOOTH),
        sphere(f"{leg}_foot_collision", calf, 0.023, (0, 0, -0.213), **_GO1_FOOT),
    )


@dataclass(frozen=True, kw_only=True)
class UnitreeGo1(UnitreeQuadruped):
    """Go1's facts, with reflected motor inertia and position servos, and `spec()`, the model that they describe."""

    name: ClassVar[str] = "go1"
    root_body: ClassVar[str] = "trunk"
    model: ClassVar[str] = "unitree_go1/go1"

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.278)
    action_scale: Mapping[str, float] = field(
        default_factory=lambda: spread(GO1_ACTION_SCALE, JOINTS)
    )
    actuators: tuple[Actuator, ...] = GO1_SERVOS

    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = (
        box("trunk_collision", "trunk", (0.13, 0.09, 0.05), **_GO1_SMOOTH),
        sphere("head_collision", "trunk", 0.06, (0.24, 0.0, 0.0), **_GO1_SMOOTH),
        *(geom for leg in LEGS for geom in _go1_leg_geoms(leg)),
    )
    sites: ClassVar[tuple[Site, ...]] = (
        Site(name="imu", body="trunk", pos=(-0.01592, -0.06659, -0.00617)),
    )

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh, editable model of the robot alone, whose free joint has a name."""
        spec = super().spec()
        # The menagerie leaves the free joint without a name, which terms need to look it up.
        for joint in spec.joints:
            if joint.type == mujoco.mjtJoint.mjJNT_FREE:
                joint.name = "floating_base_joint"
        return spec


# The gains that the robot's own low-level interface is commonly run with.
_GO2_GAINS: dict[str, float] = {"armature": 0.01, "stiffness": 30.0, "damping": 1.0}
GO2_MOTORS = (
    IdealPDActuator(joints=_LIGHT_JOINTS, effort_limit=23.7, **_GO2_GAINS),
    IdealPDActuator(joints=_CALF_JOINTS, effort_limit=45.43, **_GO2_GAINS),
)
_GO2_TREAD: GeomAttributes = {"friction": (0.8, 0.02, 0.01), "priority": 1, "solref": (0.01, 1.0)}
_GO2_FOOT = (-0.002, 0.0, -0.213)
"""The centre of a foot's ball in the calf's frame, m; its radius is 0.022 m."""


def _go2_leg_geoms(leg: str) -> tuple[CollisionGeom, ...]:
    y = 1.0 if leg.endswith("L") else -1.0
    thigh = f"{leg}_thigh"
    calf = f"{leg}_calf"
    return (
        capsule(
            f"{leg}_hip_collision",
            f"{leg}_hip",
            0.046,
            (0, 0.06 * y, 0, 0, 0.1 * y, 0),
            **_GO2_SMOOTH,
        ),
        capsule(f"{thigh}_collision", thigh, 0.017, (0, 0, -0.01, 0, 0, -0.2), **_GO2_SMOOTH),
        capsule(f"{calf}_collision", calf, 0.012, (0.008, 0, -0.02, 0.02, 0, -0.17), **_GO2_SMOOTH),
        sphere(f"{leg}_foot_collision", calf, 0.022, _GO2_FOOT, **_GO2_TREAD),
    )


@dataclass(frozen=True, kw_only=True)
class UnitreeGo2(UnitreeQuadruped):
    """Go2's facts, with plain torque motors under PD control, and `spec()`, the model that they describe."""

    name: ClassVar[str] = "go2"
    root_body: ClassVar[str] = "base"
    model: ClassVar[str] = "unitree_go2/go2"

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.29)
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread({".*": 0.25}, JOINTS))
    actuators: tuple[Actuator, ...] = GO2_MOTORS

    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = (
        box("base_collision", "base", (0.1881, 0.04675, 0.057), **_GO2_SMOOTH),
        sphere("head_collision", "base", 0.06, (0.29, 0.0, -0.02), **_GO2_SMOOTH),
        *(geom for leg in LEGS for geom in _go2_leg_geoms(leg)),
    )
    sites: ClassVar[tuple[Site, ...]] = (
        Site(name="imu", body="base", pos=(-0.02557, 0.0, 0.04232)),
        # Foot sites are the centres of the feet's balls.
        *(Site(name=leg, body=f"{leg}_calf", pos=_GO2_FOOT) for leg in LEGS),
    )
