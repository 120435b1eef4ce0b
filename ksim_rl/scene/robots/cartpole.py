"""The cartpole of `cartpole.xml`: joints "slider" (m) and "hinge" (rad from upright), one motor "slide" of 10 N."""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec


@dataclass(frozen=True, kw_only=True)
class Cartpole:
    """A 1 kg cart on a 3.6 m rail with a 0.1 kg pole of 1 m."""

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        return load_spec(files("ksim_rl.scene.robots").joinpath("cartpole.xml").read_text())
