"""Decides which parameters of a joint a log can identify, and where their search begins."""

import math
from dataclasses import dataclass

import numpy as np

from ksim_rl.identification.held_robot import KINDS, DrivenJoint, HeldRobot
from ksim_rl.identification.simulation import Targets

DELAY = "delay"
LONGEST_DELAY_S = 0.2
_DELAY_SCALE_S = 0.01
_UNLIMITED_EFFORT = 20.0
"""N m or N: the size of efforts of a motor whose files give no limit."""
_LARGEST = 100.0
"""How many times its usual size a number may have."""
_ONLY_SUM = "of servo and joint together, as no velocities were commanded"
_WITHIN_SERVO = "the servo's has it, too: it takes commanded velocities to tell them apart"
_NO_EFFORTS = "no efforts were commanded"
_NO_POSITIONS = "no positions were commanded"
_NO_SERVO = "no velocities were commanded, and the robot's files have no servo"


@dataclass(frozen=True, kw_only=True)
class FreeNumber:
    """A number that is searched, in units of `scale`, from `start` up to `highest`.

    It belongs to the joint at the place `joint`; the delay, which belongs to none, has None.
    """

    joint: int | None
    kind: str
    scale: float
    start: float
    highest: float = _LARGEST

    @property
    def name(self) -> str:
        """A name that no other number of the search has."""
        return f"{self.kind} {self.joint}"


def free_numbers(robot: HeldRobot, targets: Targets) -> list[FreeNumber]:
    """Return the numbers that are searched with targets of these kinds, the delay last."""
    free = []
    for place, joint in enumerate(robot.joints):
        held = untold(joint, targets, place)
        scales = _scales(joint)
        for kind in KINDS:
            if kind not in held:
                # Never from zero: there the search would begin at a bound.
                start = max(joint.nominal[kind] / scales[kind], 0.1)
                free.append(FreeNumber(joint=place, kind=kind, scale=scales[kind], start=start))
    highest = LONGEST_DELAY_S / _DELAY_SCALE_S
    free.append(
        FreeNumber(joint=None, kind=DELAY, scale=_DELAY_SCALE_S, start=0.5, highest=highest)
    )
    return free


def untold(joint: DrivenJoint, targets: Targets, place: int) -> dict[str, str]:
    """Return the numbers of a joint that these targets cannot tell, with the reasons."""
    asked = {
        kind for kind, values_TN in targets.by_kind.items() if np.ptp(values_TN[:, place]) > 0.0
    }
    held = {}
    if "pos" not in asked:
        held["stiffness"] = _NO_POSITIONS
    if "effort" not in asked:
        held["torque_constant"] = _NO_EFFORTS
    if "vel" not in asked:
        # One of the two takes the sum of both.
        if joint.nominal["stiffness"] > 0.0 or joint.nominal["servo_damping"] > 0.0:
            held["damping"] = _WITHIN_SERVO
        else:
            held["servo_damping"] = _NO_SERVO
    return held


def remark_of_sum(joint: DrivenJoint, held: dict[str, str]) -> dict[str, str]:
    """Return remarks on parameters that include another one, by kind."""
    if "damping" in held:
        own = joint.nominal["damping"]
        if own > 0.0:
            return {"servo_damping": f"{_ONLY_SUM}, less the joint's {own:g} of the robot's files"}
        return {"servo_damping": _ONLY_SUM}
    return {}


def _scales(joint: DrivenJoint) -> dict[str, float]:
    """Return the usual sizes of a joint's numbers."""
    nominal = joint.nominal
    effort = joint.effort_limit if math.isfinite(joint.effort_limit) else _UNLIMITED_EFFORT
    return {
        "armature": max(nominal["armature"], 1e-3),
        "damping": max(nominal["damping"], 0.1 * nominal["servo_damping"], 1e-3 * effort),
        "frictionloss": max(nominal["frictionloss"], 0.01 * effort),
        "stiffness": nominal["stiffness"] or effort,
        "servo_damping": nominal["servo_damping"] or 0.02 * effort,
        "torque_constant": nominal["torque_constant"],
    }
