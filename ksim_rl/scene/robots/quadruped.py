"""The quadruped of `quadruped.xml`: 12 kg on four legs with three joints each; nothing to download.

Joints are called `<front|rear>_<left|right>_<roll|hip|knee>`. Left and right joints turn about the same axes, so that
mirroring the robot about its x-z plane swaps "left" and "right" and changes the sign of the rolls.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import ClassVar

import mujoco

from ksim_rl.physics import load_spec

LEGS = ("front_left", "front_right", "rear_left", "rear_right")


@dataclass(frozen=True, kw_only=True)
class Quadruped:
    """The facts of the robot; gains, limits and the stance (keyframe `stand`) are in the model.

    Attributes:
        joint_names: the actuated joints in policy order (that of actions and joint observations).
        action_scale: rad per unit action, by joint pattern.
        soft_joint_pos_limit_factor: the part of each joint's range, about its middle, that is free of penalty.
    """

    action_scale: Mapping[str, float] = field(default_factory=lambda: {".*_roll": 0.2, ".*_(hip|knee)": 0.3})
    soft_joint_pos_limit_factor: float = 0.9

    name: ClassVar[str] = "quadruped"
    root_body: ClassVar[str] = "trunk"
    joint_names: ClassVar[tuple[str, ...]] = tuple(
        f"{leg}_{kind}" for leg in LEGS for kind in ("roll", "hip", "knee")
    )
    foot_geoms: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot" for leg in LEGS)
    foot_sites: ClassVar[tuple[str, ...]] = tuple(f"{leg}_foot" for leg in LEGS)

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the robot alone."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("quadruped.xml").read_text())
