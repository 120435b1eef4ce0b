"""Drives joints: by MuJoCo's own actuators, or by motor models that run before each physics substep.

A robot lists entries in its `actuators`, puts them into its model by `set_actuators(spec, self.actuators)`, and each
entry says by name or pattern which joints it drives.
"""

from ksim_rl.scene.actuators.actuator import Actuator
from ksim_rl.scene.actuators.builtin import MotorActuator, PositionActuator, VelocityActuator
from ksim_rl.scene.actuators.joint_drives import JointDrives, set_actuators
from ksim_rl.scene.actuators.motors import (
    DCMotorActuator,
    DelayedActuator,
    IdealPDActuator,
    without_delay,
)
from ksim_rl.scene.actuators.nets import LSTMActuator, MLPActuator
from ksim_rl.scene.state.buffers import ActuatorParams
from ksim_rl.scene.state.joint_targets import JointTargets

__all__ = [
    "set_actuators",
    "without_delay",
    *sorted(name for name, value in vars().items() if isinstance(value, type)),
]  # pyright: ignore
