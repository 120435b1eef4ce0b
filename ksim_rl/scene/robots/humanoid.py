"""The humanoid of `humanoid.xml`: 0.95 m, 19 kg, 19 joints; nothing to download.

Joints are called `<left|right>_<kind>`, but for `waist_yaw`. Left and right joints turn about the same axes, so that
mirroring the robot about its x-z plane swaps "left" and "right" and changes the sign of rolls and yaws.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import ClassVar

import mujoco

from ksim_rl.physics import load_spec

SIDES = ("left", "right")
_ARM = ("shoulder_pitch", "shoulder_roll", "elbow")
_LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")


@dataclass(frozen=True, kw_only=True)
class Humanoid:
    """The facts of the robot; gains, limits and the stance (keyframe `stand`) are in the model.

    Attributes:
        joint_names: the actuated joints in policy order (that of actions and joint observations).
        action_scale: rad per unit action, by joint pattern.
        soft_joint_pos_limit_factor: the part of each joint's range, about its middle, that is free of penalty.
    """

    action_scale: Mapping[str, float] = field(default_factory=lambda: {".*": 0.3})
    soft_joint_pos_limit_factor: float = 0.9

    name: ClassVar[str] = "humanoid"
    root_body: ClassVar[str] = "pelvis"
    torso_body: ClassVar[str] = "torso"
    joint_names: ClassVar[tuple[str, ...]] = (
        "waist_yaw",
        *(f"{side}_{kind}" for side in SIDES for kind in _ARM),
        *(f"{side}_{kind}" for side in SIDES for kind in _LEG),
    )
    foot_bodies: ClassVar[tuple[str, ...]] = tuple(f"{side}_foot" for side in SIDES)
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(
        f"{side}_foot_{edge}" for side in SIDES for edge in ("inner", "outer")
    )
    foot_sites: ClassVar[tuple[str, ...]] = tuple(f"{side}_foot" for side in SIDES)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the robot alone."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("humanoid.xml").read_text())
