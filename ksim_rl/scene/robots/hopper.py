"""The one-legged planar robot of `hopper.xml`: motors at "waist", "hip", "knee" and "ankle".

It moves in the xz plane: "root_x" (m), "root_z" (m, the torso's height) and "root_y" (rad, positive nose down). The
sensor "com_velocity" reads the velocity of the centre of mass, world frame.
"""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec

LEG = "waist|hip|knee|ankle"


@dataclass(frozen=True, kw_only=True)
class Hopper:
    """7.8 kg; the torso is 0.93 m up when it stands with a bent knee."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("hopper.xml").read_text())
