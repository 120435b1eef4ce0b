"""The two-legged planar robot of `walker.xml`: hip, knee and ankle of each leg have a motor.

It moves in the xz plane: "root_x" (m), "root_z" (m, the torso's height) and "root_y" (rad, positive nose down). The
sensor "com_velocity" reads the velocity of the centre of mass, world frame.
"""

from dataclasses import dataclass
from importlib.resources import files

import mujoco

from ksim_rl.physics import load_spec
from ksim_rl.scene.actuators import Actuator, PositionActuator, set_actuators

LEGS = "(right|left)_(hip|knee|ankle)"
SERVOS = (
    PositionActuator(joints=".*_(hip|knee)", stiffness=250.0, damping=10.0, effort_limit=120.0),
    PositionActuator(joints=".*_ankle", stiffness=80.0, damping=3.0, effort_limit=50.0),
)
"""Position servos for the legs, in place of the motors of `walker.xml`."""


@dataclass(frozen=True, kw_only=True)
class Walker:
    """22 kg, 1.7 m tall; the torso's middle is 1.23 m up when it stands.

    Attributes:
        actuators: what drives joints, in place of their motors; such as `SERVOS`.
    """

    actuators: tuple[Actuator, ...] = ()

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = load_spec(files("ksim_rl.scene.robots").joinpath("walker.xml").read_text())
        set_actuators(spec, self.actuators)
        return spec
