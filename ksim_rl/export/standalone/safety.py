"""Ends a loop's motion after measurements that are late, wrong or beyond limits, and limits a motor's torque."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from ksim_rl.export.standalone.files import Array
from ksim_rl.export.standalone.robot_link import (
    DOWN,
    DescribedJoints,
    JointCommand,
    Measurement,
    to_root_axes,
)

LEAST_LIMITS = {"late_periods": 1.0, "effort_share": 0.01}
"""The least value of these; 0 of the others. Without effort no motor could brake."""


class Fault(Exception):  # noqa: N818
    """Why motors are damped from now on, in one line."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """The limits of a robot's motion.

    Attributes:
        late_periods: periods without a new message, or by which the loop itself may be late.
        most_tilt: of the root's z axis from the vertical, rad.
        position_margin: beyond the limits of positions in export.json, rad or m.
        most_speed: of joints whose motors have no speed limit in export.json, rad/s or m/s.
        same_seconds: for which all that a robot with a gyroscope measures may be the same.
        effort_share: of the effort limits in export.json that commands may ask for.
    """

    late_periods: float = 3.0
    most_tilt: float = 1.0
    position_margin: float = 0.2
    most_speed: float = 35.0
    same_seconds: float = 0.5
    effort_share: float = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            lowest = LEAST_LIMITS.get(field.name, 0.0)
            highest = 1.0 if field.name == "effort_share" else math.inf
            if not lowest <= value <= highest:
                option = option_of(field.name)
                raise ValueError(f"{option} {value:g}: expected {lowest:g} to {highest:g}")


def option_of(name: str) -> str:
    """Return the option of the loop that sets a field."""
    return "--" + name.replace("_", "-")


class Watch:
    """Finds faults in a robot's measurements; each method raises Fault with one line that names it."""

    def __init__(self, joints: DescribedJoints, limits: Limits, period: float) -> None:
        self.joints = joints
        self.limits = limits
        self.longest = limits.late_periods * period
        no_limit = np.isinf(joints.most_speed)
        self.most_speed = np.where(no_limit, limits.most_speed, joints.most_speed)
        # What the last message said, and since when.
        self.count: int | None = None
        self.counted_at = 0.0
        self.given: set[str] = set()
        self.estimated: set[str] = set()
        self.readings: list[Array] = []
        self.changed_at = 0.0

    def message(self, now: float, measurement: Measurement | None) -> Measurement:
        """Refuse a measurement that is missing, late, stamped by another clock, repeated, incomplete or not finite."""
        if measurement is None:
            raise Fault("no message from the robot")
        age = now - measurement.stamp
        if age > self.longest:
            raise Fault(
                f"no message from the robot for {age:.3f} s: expected one in {self.longest:.3f} s"
            )
        # By such a clock no message would ever be late. A stamp that is NaN comes here, too.
        if not age >= -self.longest:
            raise Fault(
                f"a message's stamp is {-age:.3f} s ahead of the loop: expected s of time.monotonic"
            )
        self._numbers(measurement)
        self._news(measurement)
        return measurement

    def _news(self, measurement: Measurement) -> None:
        """Refuse a state that a firmware sends again and again, in messages that are new."""
        # By the stamps of the messages: where none comes any more, the last one is late.
        stamp = measurement.stamp
        if measurement.count is None or measurement.count != self.count:
            self.count = measurement.count
            self.counted_at = stamp
        stood = stamp - self.counted_at
        if stood > self.longest:
            raise Fault(
                f"the robot sends one state again and again: its count is {self.count} for {stood:.3f} s"
            )
        # Encoders of a robot at rest may read the same for long; a gyroscope has noise.
        if measurement.root_ang_vel is None:
            return
        readings = [measurement.joint_pos, measurement.joint_vel, measurement.joint_effort]
        readings.append(measurement.root_ang_vel)
        if measurement.root_quat is not None:
            readings.append(measurement.root_quat)
        is_same = len(readings) == len(self.readings) and all(
            map(np.array_equal, readings, self.readings)
        )
        if not is_same:
            # Copies: a robot may write into its arrays.
            self.readings = [values.copy() for values in readings]
            self.changed_at = stamp
        same = stamp - self.changed_at
        if same > self.limits.same_seconds:
            raise Fault(
                f"the robot has measured the same for {same:.3f} s, its gyroscope too: does it send one state again "
                "and again?"
            )

    def _numbers(self, measurement: Measurement) -> None:
        names = self.joints.names
        of_joints = ("joint_pos", "joint_vel", "joint_effort")
        for what in ("root_quat", "root_ang_vel", "count"):
            if getattr(measurement, what) is not None:
                self.given.add(what)
            # What watches it would see nothing any more.
            elif what in self.given:
                raise Fault(f"no {what} in a message: the ones before had it")
        sizes: dict[str, int] = dict.fromkeys(of_joints, len(names))
        if measurement.root_quat is not None:
            sizes["root_quat"] = 4
        if measurement.root_ang_vel is not None:
            sizes["root_ang_vel"] = 3
        for what, size in sizes.items():
            values = getattr(measurement, what)
            if values.shape != (size,):
                raise Fault(f"{what} has the shape {values.shape}: expected ({size},)")
        for what in of_joints:
            values = getattr(measurement, what)
            bad = np.flatnonzero(~np.isfinite(values))
            if bad.size:
                raise Fault(f"{what} of {names[bad[0]]} is {values[bad[0]]}")
        others = {"root_quat": measurement.root_quat, "root_ang_vel": measurement.root_ang_vel}
        for what, values in (others | dict(measurement.estimates)).items():
            if values is not None and not np.isfinite(values).all():
                raise Fault(f"{what} is {values.tolist()}")
        self.estimated |= measurement.estimates.keys()
        for what in sorted(self.estimated - measurement.estimates.keys()):
            raise Fault(f"no {what} in a message: the ones before had it")
        if measurement.root_quat is not None:
            length = float(np.linalg.norm(measurement.root_quat))
            if not 0.99 <= length <= 1.01:
                raise Fault(f"root_quat has the length {length:.3f}: expected 1")

    def motion(self, measurement: Measurement) -> None:
        """Refuse joints that are out of their limits, or too fast, and a robot that falls."""
        joints = self.joints
        margin = self.limits.position_margin
        low = joints.lowest - margin
        high = joints.highest + margin
        pos = measurement.joint_pos
        for place in np.flatnonzero((pos < low) | (pos > high)):
            raise Fault(
                f"{joints.names[place]} is at {pos[place]:.3f}: expected {low[place]:.3f} to {high[place]:.3f}"
            )
        speed = np.abs(measurement.joint_vel)
        for place in np.flatnonzero(speed > self.most_speed):
            raise Fault(
                f"{joints.names[place]} moves with {speed[place]:.1f} per s: expected at most "
                f"{self.most_speed[place]:.1f}"
            )
        if measurement.root_quat is not None:
            tilt = tilt_of(measurement.root_quat)
            if tilt > self.limits.most_tilt:
                raise Fault(
                    f"tilted by {math.degrees(tilt):.0f} degrees: expected at most "
                    f"{math.degrees(self.limits.most_tilt):.0f}"
                )


def check_finite(command: JointCommand, names: list[str]) -> None:
    """Refuse a command that a policy made of numbers beyond all bounds."""
    for field in dataclasses.fields(command):
        bad = np.flatnonzero(~np.isfinite(getattr(command, field.name)))
        if bad.size:
            raise Fault(f"the policy's target of {names[bad[0]]} ({field.name}) is not finite")


def unguarded(joints: DescribedJoints, measurement: Measurement) -> list[str]:
    """Return a line for each thing that nothing limits, holds or brakes, as export.json or the robot has no number."""
    lacks = {
        "no limit of effort": np.isinf(joints.most_effort),
        "no stiffness, so that nothing holds them in stand": joints.stiffness == 0.0,
        "no damping, so that nothing brakes them": joints.damping == 0.0,
    }
    lines = []
    for what, places in lacks.items():
        names = [joints.names[place] for place in np.flatnonzero(places & joints.driven)]
        if names:
            lines.append(f"{what}: {', '.join(names)}")
    if measurement.root_quat is None:
        lines.append("no attitude: the tilt is not watched")
    if measurement.root_ang_vel is None and measurement.count is None:
        lines.append(
            "no gyroscope and no count: a state that is sent again and again is not noticed"
        )
    return lines


def tilt_of(root_quat: Array) -> float:
    """Return the angle between a root's z axis and the vertical, rad."""
    down = to_root_axes(root_quat, DOWN)
    return math.acos(min(1.0, max(-1.0, -float(down[2]))))


class EffortLimit:
    """Keeps commands within the motors' effort limits at the measured state, and counts how often it has to.

    Targets of positions are moved, to between the measured position and the target. Where damping and effort alone are
    beyond the limit, all of a joint's command is made smaller: a target, or an effort, that made up for a brake that is
    too strong would drive the joint as soon as it stands still.
    """

    def __init__(self, joints: DescribedJoints, share: float) -> None:
        self.names = joints.names
        self.most = share * joints.most_effort
        self.counts = np.zeros(len(joints.names), int)

    def __call__(self, command: JointCommand, measurement: Measurement) -> JointCommand:
        """Return the command whose efforts, at the measured positions and speeds, are within the limits."""
        away = command.pos - measurement.joint_pos
        faster = command.vel - measurement.joint_vel
        others = command.effort + command.damping * faster
        effort = command.stiffness * away + others
        within = np.clip(effort, -self.most, self.most)
        over = effort != within
        if not over.any():
            return command
        self.counts += over
        is_smaller = over & (np.abs(others) > self.most)
        is_moved = over & ~is_smaller
        pos = command.pos.copy()
        pos[is_moved] += (within - effort)[is_moved] / command.stiffness[is_moved]
        share = np.ones(len(pos))
        share[is_smaller] = within[is_smaller] / effort[is_smaller]
        return dataclasses.replace(
            command,
            pos=pos,
            effort=share * command.effort,
            stiffness=share * command.stiffness,
            damping=share * command.damping,
        )

    def clipped(self) -> dict[str, int]:
        """Return how many commands were moved, by joint, of those that were."""
        places = np.flatnonzero(self.counts)
        return {self.names[place]: int(self.counts[place]) for place in places}
