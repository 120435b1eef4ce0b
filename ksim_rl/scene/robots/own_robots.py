"""The legged robots of our own, each in an MJCF file beside this one, with gains, limits and the keyframe `stand`.

Left and right joints turn about the same axes, so that mirroring a robot about its x-z plane swaps "left" and "right"
and changes the sign of rolls and yaws.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from ksim_rl.checked import Share
from ksim_rl.scene.robots.control_models import ShippedModel

# Order of the joints in policies: front before rear, left before right.
LEGS = ("front_left", "front_right", "rear_left", "rear_right")
SIDES = ("left", "right")
_ARM = ("shoulder_pitch", "shoulder_roll", "elbow")
_LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")


@dataclass(frozen=True, kw_only=True)
class Quadruped(ShippedModel):
    """12 kg on four legs with three joints each, called `<front|rear>_<left|right>_<roll|hip|knee>`."""

    name: ClassVar[str] = "quadruped"

    action_scale: Mapping[str, float] = field(
        default_factory=lambda: {".*_roll": 0.2, ".*_(hip|knee)": 0.3}
    )
    soft_joint_pos_limit_factor: Share = 0.9

    root_body: ClassVar[str] = "trunk"
    joint_names: ClassVar[tuple[str, ...]] = tuple(
        f"{leg}_{kind}" for leg in LEGS for kind in ("roll", "hip", "knee")
    )
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot" for leg in LEGS)
    # Geom and site of a foot have the same name.
    foot_sites: ClassVar[tuple[str, ...]] = foot_geoms


@dataclass(frozen=True, kw_only=True)
class Humanoid(ShippedModel):
    """0.95 m, 19 kg, 19 joints, called `<left|right>_<kind>`, but for `waist_yaw`; fields as of `LeggedRobot`."""

    name: ClassVar[str] = "humanoid"

    action_scale: Mapping[str, float] = field(default_factory=lambda: {".*": 0.3})
    soft_joint_pos_limit_factor: Share = 0.9

    root_body: ClassVar[str] = "pelvis"
    torso_body: ClassVar[str] = "torso"
    joint_names: ClassVar[tuple[str, ...]] = (
        "waist_yaw",
        *(f"{side}_{kind}" for side in SIDES for kind in _ARM),
        *(f"{side}_{kind}" for side in SIDES for kind in _LEG),
    )
    foot_bodies: ClassVar[tuple[str, ...]] = tuple(f"{side}_foot" for side in SIDES)
    # Two geoms per foot, along its edges.
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(
        f"{side}_foot_{edge}" for side in SIDES for edge in ("inner", "outer")
    )
    foot_sites: ClassVar[tuple[str, ...]] = foot_bodies
