"""Unitree G1 with 29 joints: the menagerie's model with reflected motor inertia and position servos.

Frames: the root is `pelvis` (x forward, y left, z up). Masses, joints and ranges are from
mujoco_menagerie/unitree_g1. Servo gains follow from the motors' gear trains and a chosen 10 Hz, as in BeyondMimic
(Liao et al., 2025) and mjlab 1.6.0, whose figures these are, the stance and the collision set included.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from ksim_rl.scene.actuators import Actuator, PositionActuator
from ksim_rl.scene.robots.edit import (
    CollisionGeom,
    Site,
    capsule,
    reflected_inertia,
    sphere,
    spread,
)
from ksim_rl.scene.robots.legged_robot import MenagerieRobot

# The model's order: legs, waist, arms, left before right.
SIDES = ("left", "right")
_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = (
    "shoulder_pitch",
    "shoulder_roll",
    "shoulder_yaw",
    "elbow",
    "wrist_roll",
    "wrist_pitch",
    "wrist_yaw",
)
JOINTS = (
    *(f"{side}_{kind}_joint" for side in SIDES for kind in _LEG),
    *(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")),
    *(f"{side}_{kind}_joint" for side in SIDES for kind in _ARM),
)

# Motors by Unitree's names: two-stage planetary gears, but for the 4010.
_M5020 = reflected_inertia((0.139e-4, 0.017e-4, 0.169e-4), (1.0 + 46.0 / 18.0, 1.0 + 56.0 / 16.0))
_M7520_14 = reflected_inertia((0.489e-4, 0.098e-4, 0.533e-4), (4.5, 1.0 + 48.0 / 22.0))
_M7520_22 = reflected_inertia((0.489e-4, 0.109e-4, 0.738e-4), (4.5, 5.0))
_M4010 = reflected_inertia((0.068e-4, 0.0, 0.0), (5.0, 5.0))
_ARM_JOINTS = (".*_shoulder_.*", ".*_elbow_joint", ".*_wrist_roll_joint")
_TURN_JOINTS = (".*_hip_pitch_joint", ".*_hip_yaw_joint", "waist_yaw_joint")
_LIFT_JOINTS = (".*_hip_roll_joint", ".*_knee_joint")
_HAND_JOINTS = (".*_wrist_pitch_joint", ".*_wrist_yaw_joint")
_WAIST_JOINTS = ("waist_roll_joint", "waist_pitch_joint")
_ANKLE_JOINTS = (".*_ankle_.*",)

SERVOS = (
    PositionActuator.tuned(joints=_ARM_JOINTS, effort_limit=25.0, armature=_M5020),
    PositionActuator.tuned(joints=_TURN_JOINTS, effort_limit=88.0, armature=_M7520_14),
    PositionActuator.tuned(joints=_LIFT_JOINTS, effort_limit=139.0, armature=_M7520_22),
    PositionActuator.tuned(joints=_HAND_JOINTS, effort_limit=5.0, armature=_M4010),
    # Waist and ankles: two 5020 that drive a four-bar linkage together.
    PositionActuator.tuned(joints=_WAIST_JOINTS, effort_limit=50.0, armature=2.0 * _M5020),
    PositionActuator.tuned(joints=_ANKLE_JOINTS, effort_limit=50.0, armature=2.0 * _M5020),
)
# A unit action moves the target by a quarter of the deflection at which the servo saturates (effort_limit / kp).
ACTION_SCALE = {
    **dict.fromkeys((*_ARM_JOINTS, *_WAIST_JOINTS, *_ANKLE_JOINTS), 0.43858),
    **dict.fromkeys(_TURN_JOINTS, 0.54755),
    **dict.fromkeys(_LIFT_JOINTS, 0.35066),
    **dict.fromkeys(_HAND_JOINTS, 0.0745),
}
STANCE = {
    ".*_hip_pitch_joint": -0.312,
    ".*_knee_joint": 0.669,
    ".*_ankle_pitch_joint": -0.363,
    ".*_shoulder_pitch_joint": 0.2,
    "left_shoulder_roll_joint": 0.2,
    "right_shoulder_roll_joint": -0.2,
    ".*_elbow_joint": 0.6,
}

# Seven capsules of 1 cm radius along each foot: (x, y) of their ends, in the ankle's frame.
_SOLE = (
    ((-0.044, -0.018), (0.123, -0.018)),
    ((-0.052, -0.010), (0.130, -0.010)),
    ((-0.054, 0.000), (0.132, 0.000)),
    ((-0.052, 0.010), (0.130, 0.010)),
    ((-0.044, 0.018), (0.123, 0.018)),
)
_INNER_EDGE = {"left": ((0.1, -0.026), (0.05, -0.027)), "right": ((0.1, -0.026), (0.05, -0.026))}
_OUTER_EDGE = ((0.1, 0.026), (0.05, 0.026))
_SOLE_Z = -0.025


def _foot_geoms(side: str) -> tuple[CollisionGeom, ...]:
    ends = (_INNER_EDGE[side], *_SOLE, _OUTER_EDGE)
    return tuple(
        capsule(
            f"{side}_foot{number}_collision",
            f"{side}_ankle_roll_link",
            0.01,
            # Both ends lie in the plane of the sole.
            (*first, _SOLE_Z, *second, _SOLE_Z),
            # Sliding, torsional (m) and rolling (m); the feet's priority makes it hold on any ground.
            friction=(0.6, 0.005, 0.0001),
            priority=1,
        )
        for number, (first, second) in enumerate(ends, 1)
    )


def _side_geoms(side: str) -> tuple[CollisionGeom, ...]:
    # The hand leans inwards, so that its y changes sign with the side.
    y = 1.0 if side == "left" else -1.0
    legs = (
        ("hip", "hip_roll", 0.06, (0.02, 0, 0, 0.02, 0, -0.08)),
        ("thigh", "hip_yaw", 0.055, (0, 0, -0.03, -0.06, 0, -0.17)),
        ("shin", "knee", 0.045, (0.01, 0, 0, 0.01, 0, -0.15)),
        ("linkage_brace", "knee", 0.03, (0.01, 0, -0.2, 0.01, 0, -0.28)),
    )
    arms = (
        ("shoulder_yaw", "shoulder_yaw", 0.035, (0, 0, -0.08, 0, 0, 0.05)),
        ("elbow_yaw", "elbow", 0.035, (-0.01, 0, -0.01, 0.08, 0, -0.01)),
        ("wrist", "wrist_pitch", 0.035, (-0.01, 0, 0, 0.06, 0, 0)),
        ("hand", "wrist_yaw", 0.035, (0.07, 0, 0, 0.15, -0.02 * y, 0)),
    )
    limbs = [
        # One dimension: limbs push each other apart without friction.
        capsule(f"{side}_{name}_collision", f"{side}_{link}_link", radius, ends, condim=1)
        for name, link, radius, ends in (*legs, *arms)
    ]
    # Feet stand between legs and arms.
    return (*limbs[: len(legs)], *_foot_geoms(side), *limbs[len(legs) :])


@dataclass(frozen=True, kw_only=True)
class UnitreeG1(MenagerieRobot):
    """The facts of the robot, and `spec()`, the model that they describe; it stands with bent knees.

    Contacts of the robot with itself are frictionless: fewer dimensions cost less.
    """

    name: ClassVar[str] = "g1"
    root_body: ClassVar[str] = "pelvis"
    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    model: ClassVar[str] = "unitree_g1/g1"

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.76)
    default_joint_pos: Mapping[str, float] = field(
        default_factory=lambda: spread(STANCE, JOINTS, default=0.0)
    )
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread(ACTION_SCALE, JOINTS))
    actuators: tuple[Actuator, ...] = SERVOS

    imu: ClassVar[str] = "imu_in_pelvis"
    torso_body: ClassVar[str] = "torso_link"
    foot_bodies: ClassVar[tuple[str, ...]] = tuple(f"{side}_ankle_roll_link" for side in SIDES)
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(
        f"{side}_foot{number}_collision" for side in SIDES for number in range(1, 8)
    )
    foot_sites: ClassVar[tuple[str, ...]] = tuple(f"{side}_foot" for side in SIDES)
    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = (
        sphere("pelvis_collision", "pelvis", 0.07, (0.0, 0.0, -0.08), condim=1),
        capsule("torso_collision", "torso_link", 0.09, (0.01, 0.0, 0.08, 0.01, 0.0, 0.2), condim=1),
        sphere("head_collision", "torso_link", 0.06, (0.0, 0.0, 0.43), condim=1),
        *(geom for side in SIDES for geom in _side_geoms(side)),
    )
    sites: ClassVar[tuple[Site, ...]] = tuple(
        site
        for side in SIDES
        for site in (
            Site(name=f"{side}_foot", body=f"{side}_ankle_roll_link", pos=(0.04, 0.0, -0.037)),
            Site(
                name=f"{side}_palm",
                body=f"{side}_wrist_yaw_link",
                pos=(0.08, 0.0, 0.0),
                radius=0.01,
            ),
        )
    )
    # Neighbours that the capsules would let touch in every pose.
    overlaps: ClassVar[tuple[tuple[str, str], ...]] = tuple(
        pair
        for side in SIDES
        for pair in (
            ("pelvis", f"{side}_hip_roll_link"),
            (f"{side}_elbow_link", f"{side}_wrist_pitch_link"),
        )
    )
