"""Tells the meaning of the control of a joint's actuator: the target at the joint that it stands for.

MuJoCo's actuator on a hinge or slide with gear r has length r q, and exerts the effort r (g u + b0 + b1 r q + b2 r q')
on the joint, with its gain g, its bias (b0, b1, b2), and its control u (behind dynamics: its activation). The control
that rests at a target is where that effort vanishes.
"""

from typing import Literal, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

TargetKind = Literal["pos", "vel", "effort"]
SMOOTHED = (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)
"""Dynamics whose activation comes to rest at the control."""


class JointControl(NamedTuple):
    """How an actuator's control follows from the target of its joint: `control = scale * target + offset`.

    `kind` is the kind of target of the control, `refusal` why no target can be turned into it, or empty. `stiffness`
    (N m / rad or N / m) and `damping` (N m s / rad or N s / m) are at the joint, behind the gear. An activation
    that `follows` rests at `activation_scale * position + activation_offset`. Motors have the scale 1: an effort is
    their control, before gear and gain.
    """

    kind: TargetKind
    scale: float = 1.0
    offset: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    follows: bool = False
    activation_scale: float = 0.0
    activation_offset: float = 0.0
    refusal: str = ""

    def of(self, target: float) -> float:
        """Return the control for a target, rad, m, or per second."""
        return self.scale * target + self.offset

    def target(self, control: float) -> float:
        """Return the target that a control stands for; the inverse of `of`."""
        return (control - self.offset) / self.scale


def joint_control(mj_model: mujoco.MjModel, actuator: int) -> JointControl:
    """Return the meaning of the control of an actuator of a hinge or slide."""
    return _control(
        gear=float(mj_model.actuator_gear[actuator, 0]),
        gain=(int(mj_model.actuator_gaintype[actuator]), mj_model.actuator_gainprm[actuator]),
        bias=(int(mj_model.actuator_biastype[actuator]), mj_model.actuator_biasprm[actuator]),
        dyntype=int(mj_model.actuator_dyntype[actuator]),
    )


def force_limit(mj_model: mujoco.MjModel, actuator: int) -> float | None:
    """Return the effort at the joint that an actuator's force range allows both ways, N m or N; None without one."""
    if not mj_model.actuator_forcelimited[actuator]:
        return None
    # The force goes through the gear.
    return both_ways(mj_model.actuator_forcerange[actuator] * mj_model.actuator_gear[actuator, 0])


def effort_limit(mj_model: mujoco.MjModel, actuator: int) -> float | None:
    """Return the effort at the joint that an actuator can exert both ways, N m or N; None without a limit.

    A motor's control range limits its effort where no force range does.
    """
    limit = force_limit(mj_model, actuator)
    is_motor = joint_control(mj_model, actuator).kind == "effort"
    if limit is not None or not is_motor or not mj_model.actuator_ctrllimited[actuator]:
        return limit
    per_control = mj_model.actuator_gear[actuator, 0] * mj_model.actuator_gainprm[actuator, 0]
    return both_ways(mj_model.actuator_ctrlrange[actuator] * per_control)


def both_ways(range_2: Float[np.ndarray, " 2"]) -> float:
    """Return how far a range reaches both ways; where a drive acts one way only, how far it reaches that way."""
    less, more = sorted(abs(float(end)) for end in range_2)
    return less if less > 0.0 else more


def control_of_spec(actuator: mujoco.MjsActuator) -> JointControl:
    """Return the meaning of the control of an actuator that is not compiled yet."""
    return _control(
        gear=float(actuator.gear[0]),
        gain=(int(actuator.gaintype), np.asarray(actuator.gainprm)),
        bias=(int(actuator.biastype), np.asarray(actuator.biasprm)),
        dyntype=int(actuator.dyntype),
    )


def _control(
    *, gear: float, gain: tuple[int, np.ndarray], bias: tuple[int, np.ndarray], dyntype: int
) -> JointControl:
    """Return the meaning of a control; a bias against the position makes a position servo, against the velocity alone
    a velocity servo, and an integrator before a position servo makes its control a velocity.
    """
    gaintype, gainprm = gain
    biastype, biasprm = bias
    is_affine = biastype == mujoco.mjtBias.mjBIAS_AFFINE
    # Without feedback of position or velocity it is no servo: the control is the effort.
    if not is_affine or (biasprm[1] == 0.0 and biasprm[2] == 0.0):
        return JointControl("effort", refusal=_no_motor(gaintype, biastype))
    constant, per_length, per_speed = (float(number) for number in biasprm[:3])
    force = float(gainprm[0])
    # An integrator makes the activation a position, and the control its rate.
    integrates = dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
    # Feedback of position alone decides; a servo may have damping as well.
    if per_length != 0.0 and not integrates:
        kind: TargetKind = "pos"
    else:
        kind = "vel"
    refusal = _no_servo(gaintype, force, gear, per_length, per_speed, dyntype)
    if refusal:
        return JointControl(kind, refusal=refusal)
    # Zeros without a sign, and products of ones, leave the numbers of plain servos as they are, bit for bit.
    per_position = per_length * gear / -force + 0.0
    at_rest = constant / -force + 0.0
    holds_position = per_length != 0.0
    return JointControl(
        kind,
        scale=per_position if holds_position else per_speed * gear / -force + 0.0,
        # Behind an integrator the constant moves the activation, and not its speed.
        offset=0.0 if integrates else at_rest,
        stiffness=-per_length * gear * gear + 0.0,
        damping=-per_speed * gear * gear + 0.0,
        follows=holds_position and dyntype != mujoco.mjtDyn.mjDYN_NONE,
        activation_scale=per_position,
        activation_offset=at_rest,
    )


def _no_motor(gaintype: int, biastype: int) -> str:
    """Return why an actuator is no motor whose control is its effort, or nothing."""
    plain_gains = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
    plain_biases = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    # Muscles and user kinds compute their force in another way.
    if gaintype in plain_gains and biastype in plain_biases:
        return ""
    if gaintype not in plain_gains:
        named = mujoco.mjtGain(gaintype).name.removeprefix("mjGAIN_")
    else:
        named = mujoco.mjtBias(biastype).name.removeprefix("mjBIAS_")
    return f"its kind is {named.lower()}, whose control is no effort"


def _no_servo(
    gaintype: int, force: float, gear: float, per_length: float, per_speed: float, dyntype: int
) -> str:
    """Return why no control of a servo rests at a target, or nothing."""
    integrates = dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
    if gaintype != mujoco.mjtGain.mjGAIN_FIXED:
        return "its gain is not fixed"
    # Both are divided by.
    if force == 0.0 or gear == 0.0:
        return "its gain or gear is 0"
    if dyntype not in SMOOTHED and not integrates:
        return f"its dynamics are {mujoco.mjtDyn(dyntype).name.removeprefix('mjDYN_').lower()}"
    if per_length > 0.0:
        return "its bias pushes away from the position"
    if per_length == 0.0 and integrates:
        return "it integrates its control into a velocity"
    if per_length == 0.0 and per_speed > 0.0:
        return "its bias pushes along the velocity"
    return ""
