"""The small models of the control tasks, each in an MJCF file beside it; none needs a download.

Hopper, cheetah and walker move in the xz plane: "root_x" (m), "root_z" (m, the torso's height) and "root_y" (rad,
positive nose down); their sensor "com_velocity" reads the velocity of the centre of mass, world frame.
"""

from dataclasses import dataclass
from importlib.resources import files
from typing import ClassVar

import mujoco

from ksim_rl.checked import Checked
from ksim_rl.physics import load_spec
from ksim_rl.scene.actuators import Actuator, PositionActuator, set_actuators


class ShippedModel(Checked):
    """A model whose MJCF file, `<name>.xml`, comes with this package."""

    name: ClassVar[str]

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        # As text: the package may lie in an archive, where a model has no path.
        return load_spec(files("ksim_rl.scene.robots").joinpath(f"{self.name}.xml").read_text())


@dataclass(frozen=True, kw_only=True)
class Cartpole(ShippedModel):
    """A 1 kg cart on a 3.6 m rail with a 0.1 kg pole of 1 m, and one motor "slide" of 10 N.

    Its joints are "slider" (m) and "hinge" (rad from upright).
    """

    name: ClassVar[str] = "cartpole"


@dataclass(frozen=True, kw_only=True)
class Pendulum(ShippedModel):
    """A 0.5 m rod with 0.9 kg at its end, on a fixed axle: joint "hinge" (rad from upright), motor "torque" of 1.5 N m.

    Gravity's torque on the rod when it lies is 4.7 N m, so that swinging it up takes several swings.
    """

    name: ClassVar[str] = "pendulum"


@dataclass(frozen=True, kw_only=True)
class Reacher(ShippedModel):
    """Two links, 0.13 m and 0.12 m, that turn in a horizontal plane.

    Joints "shoulder" and "wrist" about z, a motor of 0.06 N m each. The site "finger" moves at z = `plane_height` (m)
    and reaches up to 0.25 m from the hub.
    """

    name: ClassVar[str] = "reacher"

    plane_height: ClassVar[float] = 0.02


@dataclass(frozen=True, kw_only=True)
class Hopper(ShippedModel):
    """7.8 kg on one leg with motors at `joints`; the torso is 0.93 m up when it stands with a bent knee."""

    name: ClassVar[str] = "hopper"

    joints: ClassVar[str] = "waist|hip|knee|ankle"


@dataclass(frozen=True, kw_only=True)
class Cheetah(ShippedModel):
    """14 kg, 1.3 m long, with a hind and a fore leg; springs hold the legs in the standing pose."""

    name: ClassVar[str] = "cheetah"

    joints: ClassVar[str] = "(hind|fore)_(hip|knee|ankle)"


WALKER_SERVOS = (
    PositionActuator(joints=".*_(hip|knee)", stiffness=250.0, damping=10.0, effort_limit=120.0),
    PositionActuator(joints=".*_ankle", stiffness=80.0, damping=3.0, effort_limit=50.0),
)
"""Position servos for the walker's legs, in place of the motors of `walker.xml`."""


@dataclass(frozen=True, kw_only=True)
class Walker(ShippedModel):
    """22 kg on two legs, 1.7 m tall, torso at 1.23 m; `actuators`, such as `WALKER_SERVOS`, replace the motors."""

    name: ClassVar[str] = "walker"

    actuators: tuple[Actuator, ...] = ()

    joints: ClassVar[str] = "(right|left)_(hip|knee|ankle)"

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = super().spec()
        # Without actuators this changes nothing.
        set_actuators(spec, self.actuators)
        return spec


@dataclass(frozen=True, kw_only=True)
class Arm(ShippedModel):
    """Four joints on a fixed base at the origin, with position servos, and a rod as pusher with the site "tip".

    Its weight is compensated, as in many small arms. The tip reaches 0.6 m from the shoulder, 0.16 m above the
    table, and points straight down in the ready pose. Only the pusher collides, with whatever has `contype` 1.
    `actuators`, such as networks that were fitted to a log, replace the servos.
    """

    name: ClassVar[str] = "arm"

    actuators: tuple[Actuator, ...] = ()

    joints: ClassVar[tuple[str, ...]] = ("yaw", "shoulder", "elbow", "wrist")
    tip: ClassVar[str] = "tip"

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the model."""
        spec = super().spec()
        # Without actuators this changes nothing.
        set_actuators(spec, self.actuators)
        return spec
