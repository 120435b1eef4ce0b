"""A robot whose actuators are other ones: late, or of another kind; all else is the robot's own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco

from ksim_rl.scene.actuators import (
    Actuator,
    DelayedActuator,
    MotorActuator,
    PositionActuator,
    VelocityActuator,
    set_actuators,
    without_delay,
)
from ksim_rl.scene.actuators.joint_drives import driven_joints
from ksim_rl.scene.names import TO_JOINTS, scalar_joint_ids
from ksim_rl.scene.scene import Robot
from ksim_rl.scene.state.joint_control import force_limit, joint_control


@dataclass(frozen=True, kw_only=True)
class ChangedRobot:
    """`robot` with `actuators`, which drive the joints that its own did; the model's other actuators stay."""

    robot: Robot
    actuators: tuple[Actuator, ...]

    def spec(self) -> mujoco.MjSpec:
        """Return a new spec of the robot alone."""
        spec = self.robot.spec()
        set_actuators(spec, self.actuators)
        return spec


@dataclass(frozen=True, kw_only=True)
class GearedMotor(MotorActuator):
    """A motor of a model, whose efforts are its controls, before gear and gain; `effort_limit` is behind the gear."""

    gear: float
    gain: float
    control_range: tuple[float, float] | None

    def configure(self, actuator: mujoco.MjsActuator, joint: mujoco.MjsJoint) -> None:
        """Set up the new actuator as the model's own was."""
        super().configure(actuator, joint)
        actuator.gear = [self.gear, 0.0, 0.0, 0.0, 0.0, 0.0]
        actuator.gainprm = [self.gain, *[0.0] * 9]
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        if self.control_range is not None:
            actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.ctrlrange = list(self.control_range)
        if self.effort_limit is not None:
            # The force of an actuator goes through its gear.
            limit = self.effort_limit / abs(self.gear)
            actuator.forcerange = [-limit, limit]


def changed(robot: Robot, change: Callable[[Actuator], Actuator]) -> ChangedRobot:
    """Return a robot in which `change` was made to the actuator of each driven joint.

    A ValueError names an actuator of the model that is no servo or motor of a joint.
    """
    return ChangedRobot(robot=robot, actuators=tuple(change(entry) for entry in entries(robot)))


def entries(robot: Robot) -> list[Actuator]:
    """Return the actuators of a robot's joints: its own entries, and entries equivalent to its model's actuators."""
    own: Sequence[Actuator] = getattr(robot, "actuators", ())
    mj_model = robot.spec().compile()
    names = [mj_model.joint(joint).name for joint in scalar_joint_ids(mj_model)]
    said = {name for _, driven in driven_joints(own, names) for name in driven}
    found = list(own)
    for actuator in range(mj_model.nu):
        if int(mj_model.actuator_trntype[actuator]) not in TO_JOINTS:
            continue
        name = mj_model.joint(mj_model.actuator_trnid[actuator, 0]).name
        if name not in said:
            found.append(_entry(mj_model, actuator, name))
    return found


def _entry(mj_model: mujoco.MjModel, actuator: int, joint: str) -> Actuator:
    """Return the entry that gives the same efforts at the joint as an actuator of a model."""
    control = joint_control(mj_model, actuator)
    if control.refusal:
        raise ValueError(f"the actuator of joint {joint!r}: {control.refusal}")
    gear = float(mj_model.actuator_gear[actuator, 0])
    how = {"joints": (joint,), "effort_limit": force_limit(mj_model, actuator)}
    if control.kind == "pos":
        return PositionActuator(stiffness=control.stiffness, damping=control.damping, **how)
    if control.kind == "vel":
        return VelocityActuator(damping=control.damping, **how)
    control_range = None
    if mj_model.actuator_ctrllimited[actuator]:
        low, high = mj_model.actuator_ctrlrange[actuator]
        control_range = (float(low), float(high))
    gain = float(mj_model.actuator_gainprm[actuator, 0])
    return GearedMotor(gear=gear, gain=gain, control_range=control_range, **how)


def late(steps: tuple[int, int]) -> Callable[[Actuator], Actuator]:
    """Return the change that lets targets arrive late, by a number of physics steps that each episode draws."""

    def change(entry: Actuator) -> Actuator:
        return DelayedActuator(
            actuator=without_delay(entry), min_lag=steps[0], max_lag=steps[1], lag_group="card"
        )

    return change
