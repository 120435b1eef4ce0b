"""The actuators that MuJoCo computes itself; their numbers are model fields, which worlds may vary.

MuJoCo's effort is `gain * ctrl + bias`, clamped to `forcerange`, times the gear. A position servo has
`actuator_gainprm[0] = stiffness` and `actuator_biasprm[1:3] = (-stiffness, -damping)`, a velocity servo
`actuator_gainprm[0] = damping` and `actuator_biasprm[2] = -damping`; the limit is `actuator_forcerange`.
"""

import math
from dataclasses import dataclass

import mujoco

from ksim_rl.checked import NonNegative, Positive
from ksim_rl.scene.actuators.actuator import Drive, JointActuator, Law
from ksim_rl.scene.names import Patterns


@dataclass(frozen=True, kw_only=True)
class BuiltinActuator(JointActuator):
    """An actuator that MuJoCo computes from one kind of target."""

    def law(self, drive: Drive) -> Law:
        # One kind of target only, as the subclass says.
        (kind,) = self.takes
        # The control is the target itself; this law runs only where another actuator delays it.
        return lambda _, target: getattr(target, f"{kind}_EN")


@dataclass(frozen=True, kw_only=True)
class PositionActuator(BuiltinActuator):
    """MuJoCo's position servo: effort = stiffness * (target - position) - damping * velocity; SI units.

    The control range that it writes is where it can change the effort at a joint limit, and does not clip: a clipped
    target would hide the policy's own target from it.
    """

    takes = frozenset({"pos"})

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
            # The error at which the servo saturates, rad or m.
            reach = self.effort_limit / self.stiffness
            low, high = _range(joint)
            actuator.ctrlrange = [low - reach, high + reach]


def _range(joint: mujoco.MjsJoint) -> tuple[float, float]:
    """Return the range of a joint that is not compiled yet, rad or m."""
    low, high = (float(edge) for edge in joint.range)
    # MuJoCo turns degrees into radians as it compiles, and only angles of joints, not the controls of their servos.
    if joint.compiler.degree and joint.type != mujoco.mjtJoint.mjJNT_SLIDE:
        return math.radians(low), math.radians(high)
    return low, high


@dataclass(frozen=True, kw_only=True)
class VelocityActuator(BuiltinActuator):
    """MuJoCo's velocity servo: effort = damping * (target - velocity), with damping in N m s / rad or N s / m."""

    takes = frozenset({"vel"})

    damping: Positive

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        super().configure(actuator, joint)
        actuator.set_to_velocity(kv=self.damping)


@dataclass(frozen=True, kw_only=True)
class MotorActuator(BuiltinActuator):
    """MuJoCo's motor: effort = target; its control range is its effort limit."""

    takes = frozenset({"effort"})

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        super().configure(actuator, joint)
        actuator.set_to_motor()
        if self.effort_limit is not None:
            # A motor's control is its effort, so that its limit is one of the control as well.
            actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.ctrlrange = [-self.effort_limit, self.effort_limit]
