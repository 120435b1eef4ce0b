"""The arm of `arm.xml`: position servos at "yaw", "shoulder", "elbow" and "wrist", a rod as pusher with the site "tip".

Its weight is compensated, as that of many small arms is by their controllers. The tip reaches 0.6 m from the shoulder,
0.16 m above the table; in the ready pose it points straight down. Only the pusher collides, with whatever has
`contype` 1.
"""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec

JOINTS = ("yaw", "shoulder", "elbow", "wrist")
TIP = "tip"


@dataclass(frozen=True, kw_only=True)
class Arm:
    """Four joints on a fixed base at the origin."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("arm.xml").read_text())
