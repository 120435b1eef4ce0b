"""This module has the actuators that MuJoCo computes itself; their numbers are model fields, which worlds may vary.

MuJoCo's effort is `gain * ctrl + bias`, clamped to `forcerange`, times the gear. A position servo has
`actuator_gainprm[0] = stiffness` and `actuator_biasprm[1:3] = (-stiffness, -damping)`, a velocity servo
`actuator_gainprm[0] = damping` and `actuator_biasprm[2] = -damping`; the limit is `actuator_forcerange`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from ksim_rl.checked import NonNegative, Positive, Range
from ksim_rl.scene.actuators.actuator import Drive, JointActuator, Law
from ksim_rl.scene.names import Patterns
from ksim_rl.scene.state.joint_targets import TargetKind, control_kind

_NUM_PARAMETERS = 10


@dataclass(frozen=True, kw_only=True)
class BuiltinActuator(JointActuator):
    """An actuator that MuJoCo computes from one kind of target."""

    def law(self, drive: Drive) -> Law:
        (kind,) = self.takes
        return lambda _, target: getattr(target, f"{kind}_EN")


@dataclass(frozen=True, kw_only=True)
class PositionActuator(BuiltinActuator, takes=frozenset({"pos"})):
    """MuJoCo's position servo: effort = stiffness * (target - position) - damping * velocity; SI units.

    The control range that it writes is what can still change the effort at a joint limit, and does not clip: a clipped
    target would hide from the policy what it asked for.
    """

    stiffness: Positive
    damping: NonNegative = 0.0

    @classmethod
    def tuned(
        cls,
        *,
        joints: Patterns,
        effort_limit: float,
        armature: float,
        natural_frequency: float = 10.0,
        damping_ratio: float = 2.0,
    ) -> "PositionActuator":
        """Return the servo whose gains make the armature a second-order system of this frequency (Hz) and damping.

        `stiffness = armature * w^2`, `damping = 2 * damping_ratio * armature * w`, `w = 2 pi * natural_frequency`.
        """
        return cls(
            joints=joints,
            effort_limit=effort_limit,
            armature=armature,
            stiffness=armature * (2.0 * math.pi * natural_frequency) ** 2,
            damping=2.0 * damping_ratio * armature * 2.0 * math.pi * natural_frequency,
        )

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        super().configure(actuator, joint)
        actuator.set_to_position(kp=self.stiffness, kv=self.damping)
        if self.effort_limit is not None:
            reach = self.effort_limit / self.stiffness
            actuator.ctrlrange = [joint.range[0] - reach, joint.range[1] + reach]


@dataclass(frozen=True, kw_only=True)
class VelocityActuator(BuiltinActuator, takes=frozenset({"vel"})):
    """MuJoCo's velocity servo: effort = damping * (target - velocity), with damping in N m s / rad or N s / m."""

    damping: Positive

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        super().configure(actuator, joint)
        actuator.set_to_velocity(kv=self.damping)


@dataclass(frozen=True, kw_only=True)
class MotorActuator(BuiltinActuator, takes=frozenset({"effort"})):
    """MuJoCo's motor: effort = target; its control range is its effort limit."""

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        super().configure(actuator, joint)
        actuator.set_to_motor()
        if self.effort_limit is not None:
            actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.ctrlrange = [-self.effort_limit, self.effort_limit]


@dataclass(frozen=True, kw_only=True)
class GeneralActuator(BuiltinActuator):
    """MuJoCo's general actuator, as in MJCF: up to ten numbers each, others 0; the first of `gear`; ranges clamp."""

    gaintype: Literal["fixed", "affine", "muscle"] = "fixed"
    gainprm: tuple[float, ...] = (1.0,)
    biastype: Literal["none", "affine", "muscle"] = "none"
    biasprm: tuple[float, ...] = ()
    dyntype: Literal["none", "integrator", "filter", "filterexact", "muscle"] = "none"
    dynprm: tuple[float, ...] = (1.0,)
    gear: float = 1.0
    ctrlrange: Range | None = None
    actrange: Range | None = None

    def _check_fields(self) -> None:
        for name in ("gainprm", "biasprm", "dynprm"):
            numbers = getattr(self, name)
            if len(numbers) > _NUM_PARAMETERS:
                raise ValueError(f"{name} has {len(numbers)} numbers: expected at most {_NUM_PARAMETERS}")

    @property
    def _enums(self) -> dict[str, Any]:
        """The members of MuJoCo's mjtGain, mjtBias and mjtDyn that the types name."""
        types = {"gain": self.gaintype, "bias": self.biastype, "dyn": self.dyntype}
        return {
            kind: getattr(getattr(mujoco, f"mjt{kind.title()}"), f"mj{kind.upper()}_{name.upper()}")
            for kind, name in types.items()
        }

    @property
    def takes(self) -> frozenset[TargetKind]:
        return frozenset({control_kind(self._enums["bias"], _padded(self.biasprm), self._enums["dyn"])})

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        super().configure(actuator, joint)
        kinds = self._enums
        actuator.gaintype, actuator.gainprm = kinds["gain"], _padded(self.gainprm)
        actuator.biastype, actuator.biasprm = kinds["bias"], _padded(self.biasprm)
        actuator.dyntype, actuator.dynprm = kinds["dyn"], _padded(self.dynprm)
        actuator.gear = [self.gear, 0.0, 0.0, 0.0, 0.0, 0.0]
        if self.ctrlrange is not None:
            actuator.ctrllimited, actuator.ctrlrange = mujoco.mjtLimited.mjLIMITED_TRUE, self.ctrlrange
        actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if self.actrange is not None:
            actuator.actlimited, actuator.actrange = mujoco.mjtLimited.mjLIMITED_TRUE, self.actrange


def _padded(numbers: Sequence[float]) -> list[float]:
    return [*numbers, *[0.0] * (_NUM_PARAMETERS - len(numbers))]
