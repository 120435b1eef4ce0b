"""Booster T1: the menagerie's model with position servos per joint group and lean collisions.

Frames: the root is `Trunk` (x forward, y left, z up). Masses, joints, ranges and torque limits are from
mujoco_menagerie/booster_t1. Its one stiffness for all joints lets the ankles give way under the body's weight, so the
gains here are chosen per group: legs and waist stiff enough to stand on, arms and head soft.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

from ksim_rl.scene.actuators import Actuator, PositionActuator
from ksim_rl.scene.robots.edit import CollisionGeom, GeomAttributes, Site, capsule, sphere, spread
from ksim_rl.scene.robots.legged_robot import MenagerieRobot

# The model's order: head, arms, waist, legs, left before right.
SIDES = ("Left", "Right")
_LEG = ("Hip_Pitch", "Hip_Roll", "Hip_Yaw", "Knee_Pitch", "Ankle_Pitch", "Ankle_Roll")
_ARM = ("Shoulder_Pitch", "Shoulder_Roll", "Elbow_Pitch", "Elbow_Yaw")
JOINTS = (
    "AAHead_yaw",
    "Head_pitch",
    *(f"{side}_{kind}" for side in SIDES for kind in _ARM),
    "Waist",
    *(f"{side}_{kind}" for side in SIDES for kind in _LEG),
)


# One armature for all motors, kg m^2.
def _servo(joints: tuple[str, ...], limit: float, *, kp: float, kd: float) -> PositionActuator:
    return PositionActuator(
        joints=joints, effort_limit=limit, armature=0.005, stiffness=kp, damping=kd
    )


SERVOS = (
    _servo(("AAHead_yaw", "Head_pitch"), 7.0, kp=20.0, kd=0.5),
    _servo((".*_Shoulder_.*", ".*_Elbow_.*"), 18.0, kp=20.0, kd=0.5),
    _servo(("Waist", ".*_Hip_Roll", ".*_Hip_Yaw"), 30.0, kp=150.0, kd=5.0),
    _servo((".*_Hip_Pitch",), 45.0, kp=150.0, kd=5.0),
    _servo((".*_Knee_Pitch",), 60.0, kp=150.0, kd=5.0),
    _servo((".*_Ankle_Pitch",), 20.0, kp=150.0, kd=4.0),
    _servo((".*_Ankle_Roll",), 15.0, kp=100.0, kd=4.0),
)
ACTION_SCALE = {".*": 0.25}
STANCE = {
    "Left_Shoulder_Roll": -1.4,
    "Right_Shoulder_Roll": 1.4,
    "Left_Elbow_Yaw": -0.4,
    "Right_Elbow_Yaw": 0.4,
    ".*_Hip_Pitch": -0.2,
    ".*_Knee_Pitch": 0.4,
    ".*_Ankle_Pitch": -0.2,
}

# Without friction, on the ground as well, where the priority decides: such contacts cost a quarter.
_SMOOTH: GeomAttributes = {"condim": 1, "priority": 1}


def _side_geoms(side: str) -> tuple[CollisionGeom, ...]:
    # The y axis points left, so that offsets to the side change sign with it.
    y = 1.0 if side == "Left" else -1.0
    low = side.lower()
    # The arm's third link bears the upper arm.
    upper_arm = f"A{side[0]}3"
    shank = f"Shank_{side}"
    soles = tuple(
        capsule(
            f"{low}_foot{number}_collision",
            f"{low}_foot_link",
            0.015,
            # The two long edges of the sole, which is 22 cm long and 10 cm wide.
            (-0.0865, 0.035 * edge, -0.015, 0.1065, 0.035 * edge, -0.015),
            friction=(0.8, 0.005, 0.0001),
            priority=1,
        )
        for number, edge in ((1, -1.0), (2, 1.0))
    )
    return (
        capsule(
            f"{low}_upper_arm_collision",
            upper_arm,
            0.03,
            (0, -0.01 * y, 0, 0, 0.11 * y, 0),
            **_SMOOTH,
        ),
        capsule(
            f"{low}_forearm_collision",
            f"{low}_hand_link",
            0.03,
            (0, 0.05 * y, 0, 0, 0.2 * y, 0),
            **_SMOOTH,
        ),
        capsule(
            f"{low}_thigh_collision",
            f"Hip_Yaw_{side}",
            0.05,
            (0, 0, 0.04, -0.01, 0, -0.08),
            **_SMOOTH,
        ),
        capsule(f"{low}_shin_collision", shank, 0.045, (0, 0, -0.05, 0, 0, -0.2), **_SMOOTH),
        *soles,
    )


@dataclass(frozen=True, kw_only=True)
class BoosterT1(MenagerieRobot):
    """The facts of the robot, and `spec()`, the model that they describe, with bent knees and hanging arms."""

    name: ClassVar[str] = "t1"
    root_body: ClassVar[str] = "Trunk"
    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    model: ClassVar[str] = "booster_t1/t1"

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.665)
    default_joint_pos: Mapping[str, float] = field(
        default_factory=lambda: spread(STANCE, JOINTS, default=0.0)
    )
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread(ACTION_SCALE, JOINTS))
    actuators: tuple[Actuator, ...] = SERVOS

    foot_bodies: ClassVar[tuple[str, ...]] = tuple(f"{side.lower()}_foot_link" for side in SIDES)
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(
        f"{side.lower()}_foot{number}_collision" for side in SIDES for number in (1, 2)
    )
    foot_sites: ClassVar[tuple[str, ...]] = tuple(f"{side.lower()}_foot" for side in SIDES)
    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = (
        capsule("trunk_collision", "Trunk", 0.1, (0.06, 0.0, 0.03, 0.06, 0.0, 0.17), **_SMOOTH),
        sphere("head_collision", "H2", 0.08, (0.01, 0.0, 0.11), **_SMOOTH),
        *(geom for side in SIDES for geom in _side_geoms(side)),
    )
    # At the origin of the trunk's frame.
    sites: ClassVar[tuple[Site, ...]] = (
        Site(name="imu", body="Trunk"),
        *(
            Site(
                name=f"{side.lower()}_foot", body=f"{side.lower()}_foot_link", pos=(0.01, 0, -0.03)
            )
            for side in SIDES
        ),
    )


@dataclass(frozen=True, kw_only=True)
class GrippingT1(BoosterT1):
    """T1 whose trunk and limbs have friction too, on the ground and on each other, for tasks in which it lies there."""

    # As MuJoCo has it where no geom has priority.
    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = tuple(
        geom if geom.name in BoosterT1.foot_geoms else replace(geom, condim=3, priority=0)
        for geom in BoosterT1.collision_geoms
    )
