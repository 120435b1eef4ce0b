"""This module has Unitree Go2: the menagerie's model, whose legs have plain torque motors, under PD control.

Frames: the root is `base` (x forward, y left, z up). Legs are FR, FL, RR, RL; each has hip (abduction, about x), thigh
and calf (about y). Masses, joints, ranges and torque limits are those of mujoco_menagerie/unitree_go2; the gains are
what the robot's own low-level interface is commonly run with. Friction and damping of the joints are left to the
controller.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import mujoco

from ksim_rl.scene.actuators import Actuator, IdealPDActuator
from ksim_rl.scene.robots.edit import CollisionGeom, Site, capsule, sphere, spread
from ksim_rl.scene.robots.legged_robot import MenagerieRobot

LEGS = ("FR", "FL", "RR", "RL")
JOINTS = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in ("hip", "thigh", "calf"))


def _motor(joints: tuple[str, ...], effort_limit: float) -> IdealPDActuator:
    return IdealPDActuator(
        joints=joints, effort_limit=effort_limit, armature=0.01, stiffness=30.0, damping=1.0
    )


MOTORS = (_motor((".*_hip_joint", ".*_thigh_joint"), 23.7), _motor((".*_calf_joint",), 45.43))
ACTION_SCALE = {".*": 0.25}
STANCE = {"[FR]R_hip_joint": 0.1, "[FR]L_hip_joint": -0.1, ".*_thigh_joint": 0.9, ".*_calf_joint": -1.8}

# Without friction, on the ground as well, where the priority decides: such contacts cost a quarter.
_SMOOTH: dict[str, Any] = {"condim": 1, "priority": 1, "solref": (0.01, 1.0)}
_FOOT_TREAD: dict[str, Any] = {"friction": (0.8, 0.02, 0.01), "priority": 1, "solref": (0.01, 1.0)}
_FOOT = (-0.002, 0.0, -0.213)
"""The centre of a foot's ball in the calf's frame, m; its radius is 0.022 m."""


def _leg_geoms(leg: str) -> tuple[CollisionGeom, ...]:
    y = 1.0 if leg.endswith("L") else -1.0
    thigh, calf = f"{leg}_thigh", f"{leg}_calf"
    return (
        capsule(f"{leg}_hip_collision", f"{leg}_hip", 0.046, (0, 0.06 * y, 0, 0, 0.1 * y, 0), **_SMOOTH),
        capsule(f"{thigh}_collision", thigh, 0.017, (0, 0, -0.01, 0, 0, -0.2), **_SMOOTH),
        capsule(f"{calf}_collision", calf, 0.012, (0.008, 0, -0.02, 0.02, 0, -0.17), **_SMOOTH),
        sphere(f"{leg}_foot_collision", calf, 0.022, _FOOT, **_FOOT_TREAD),
    )


_BASE = CollisionGeom(
    name="base_collision",
    body="base",
    type=mujoco.mjtGeom.mjGEOM_BOX,
    size=(0.1881, 0.04675, 0.057),
    **_SMOOTH,
)


@dataclass(frozen=True, kw_only=True)
class UnitreeGo2(MenagerieRobot):
    """The facts of the robot, and `spec()`, the model that they describe; fields as of `MenagerieRobot`."""

    init_pos: tuple[float, float, float] = (0.0, 0.0, 0.29)
    default_joint_pos: Mapping[str, float] = field(default_factory=lambda: spread(STANCE, JOINTS))
    action_scale: Mapping[str, float] = field(default_factory=lambda: spread(ACTION_SCALE, JOINTS))
    actuators: tuple[Actuator, ...] = MOTORS

    name: ClassVar[str] = "go2"
    root_body: ClassVar[str] = "base"
    joint_names: ClassVar[tuple[str, ...]] = JOINTS
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot_collision" for leg in LEGS)
    foot_sites: ClassVar[tuple[str, ...]] = LEGS
    model: ClassVar[str] = "unitree_go2/go2"
    collision_geoms: ClassVar[tuple[CollisionGeom, ...]] = (
        _BASE,
        sphere("head_collision", "base", 0.06, (0.29, 0.0, -0.02), **_SMOOTH),
        *(geom for leg in LEGS for geom in _leg_geoms(leg)),
    )
    sites: ClassVar[tuple[Site, ...]] = (
        Site(name="imu", body="base", pos=(-0.02557, 0.0, 0.04232)),
        *(Site(name=leg, body=f"{leg}_calf", pos=_FOOT) for leg in LEGS),
    )
