"""The pendulum of `pendulum.xml`: joint "hinge" (rad from upright), one motor "torque" of 1.5 N m.

Gravity's torque on the pole when it lies is 4.7 N m, so that swinging it up takes several swings.
"""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec


@dataclass(frozen=True, kw_only=True)
class Pendulum:
    """A 0.5 m rod with 0.9 kg at its end, on a fixed axle."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("pendulum.xml").read_text())
