"""The planar runner of `cheetah.xml`: a hind and a fore leg of hip, knee and ankle, each with a motor.

It moves in the xz plane: "root_x" (m), "root_z" (m, the torso's height) and "root_y" (rad, positive nose down). The
sensor "com_velocity" reads the velocity of the centre of mass, world frame.
"""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec

LEGS = "(hind|fore)_(hip|knee|ankle)"


@dataclass(frozen=True, kw_only=True)
class Cheetah:
    """14 kg, 1.3 m long; springs hold the legs in the standing pose."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("cheetah.xml").read_text())
