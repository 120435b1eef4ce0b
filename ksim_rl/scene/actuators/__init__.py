"""This package drives joints: by MuJoCo's own actuators, or by motor models that run before each physics substep.

A robot lists entries in its `actuators`, puts them into its model by `set_actuators(spec, self.actuators)`, and each
entry says by name or pattern which joints it drives.
"""

from ksim_rl.scene.actuators.actuator import Actuator
from ksim_rl.scene.actuators.builtin import (
    GeneralActuator,
    MotorActuator,
    PositionActuator,
    VelocityActuator,
)
from ksim_rl.scene.actuators.delayed import DelayedActuator
from ksim_rl.scene.actuators.joint_drives import JointDrives, set_actuators
from ksim_rl.scene.actuators.nets import LSTMActuator, MLPActuator
from ksim_rl.scene.actuators.pd import DCMotorActuator, IdealPDActuator
from ksim_rl.scene.state.actuator_params import ActuatorParams
from ksim_rl.scene.state.joint_targets import JointTargets

__all__ = [
    "Actuator",
    "ActuatorParams",
    "DCMotorActuator",
    "DelayedActuator",
    "GeneralActuator",
    "IdealPDActuator",
    "JointDrives",
    "JointTargets",
    "LSTMActuator",
    "MLPActuator",
    "MotorActuator",
    "PositionActuator",
    "VelocityActuator",
    "set_actuators",
]
