"""Runs a policy dry: on a robot's measurements, without sending its actions, to check its targets first."""

from collections.abc import Callable

import numpy as np

from ksim_rl.export.standalone.deadlines import Durations
from ksim_rl.export.standalone.robot_link import Control, JointCommand, Measurement, Robot
from ksim_rl.export.standalone.safety import Fault, check_finite

MOST_SHARE = 0.8
"""Of a period, that the policy's own steps may take: reading, writing and the log need the rest."""


class DryRun:
    """Steps of a policy whose commands are looked at, and not sent.

    A step that is not finite is a Fault at once. After `seconds` of steps `lines` tells what motors would have been
    asked for, and `check` refuses a policy that is too slow, or asks a standing robot for what its joints cannot do.
    `clock` tells the time, s.
    """

    def __init__(
        self,
        control: Control,
        *,
        period: float,
        seconds: float,
        margin: float,
        clock: Callable[[], float],
    ) -> None:
        self.control = control
        self.joints = control.joints
        self.period = period
        self.num_steps = max(1, round(seconds / period))
        self.lowest_pos = self.joints.lowest - margin
        self.highest_pos = self.joints.highest + margin
        self.clock = clock
        self.begin()

    def begin(self) -> None:
        """Begin an episode of the policy, and forget the last dry run."""
        self.control.begin()
        num_joints = len(self.joints.names)
        self.steps = 0
        self.took = Durations()
        self.least = np.full(num_joints, np.inf)
        self.most = np.full(num_joints, -np.inf)
        self.most_effort = np.zeros(num_joints)
        self.sum_of_pos = np.zeros(num_joints)
        self.measured = np.zeros(num_joints)

    def is_over(self) -> bool:
        """Whether all steps were run."""
        return self.steps >= self.num_steps

    def __call__(self, measurement: Measurement) -> JointCommand:
        """Run one step of the policy, and return the targets that it would have sent to the motors."""
        began = self.clock()
        asked = self.control(measurement)
        self.took.add(self.clock() - began)
        check_finite(asked, self.joints.names)
        effort = asked.effort + asked.stiffness * (asked.pos - measurement.joint_pos)
        effort = effort + asked.damping * (asked.vel - measurement.joint_vel)
        self.steps += 1
        self.least = np.minimum(self.least, asked.pos)
        self.most = np.maximum(self.most, asked.pos)
        self.most_effort = np.maximum(self.most_effort, np.abs(effort))
        self.sum_of_pos = self.sum_of_pos + asked.pos
        self.measured = measurement.joint_pos
        return asked

    def lines(self) -> list[str]:
        """Return a report of the policy's targets: a line about time, and one for each joint with a motor."""
        found = [
            f"dry run: {self.steps} steps of {1e3 * self.took.quantile(0.5):.2f} ms, 99 % of them within "
            f"{1e3 * self.took.quantile(0.99):.2f} ms; a period has {1e3 * self.period:g} ms"
        ]
        joints = self.joints
        for place in np.flatnonzero(joints.driven):
            is_beyond = (
                self.least[place] < joints.lowest[place] or self.most[place] > joints.highest[place]
            )
            mark = ": beyond its limits" if is_beyond else ""
            found.append(
                f"dry run: {joints.names[place]} is at {self.measured[place]:.3f}, would be asked for "
                f"{self.least[place]:.3f} to {self.most[place]:.3f} of {joints.lowest[place]:.3f} to "
                f"{joints.highest[place]:.3f}, with {self.most_effort[place]:.3g} of {joints.most_effort[place]:.3g}"
                f"{mark}"
            )
        return found

    def check(self, *, stands: bool) -> None:
        """Raise Fault if the policy was too slow, or asked a standing robot for positions beyond its joints' limits.

        From another pose than it has learned in, a policy may ask for anything: there only its time counts. Efforts are
        told and not refused: what is beyond their limit is never sent.
        """
        slow = self.took.quantile(0.99)
        if slow > MOST_SHARE * self.period:
            raise Fault(
                f"dry run: 1 % of the policy's steps took {1e3 * slow:.1f} ms or more: expected at most "
                f"{1e3 * MOST_SHARE * self.period:.1f} ms of a period of {1e3 * self.period:g} ms"
            )
        if not stands:
            return
        # The mean, as a short push may lead beyond a limit: the motor only pulls harder for it.
        pos = self.sum_of_pos / self.steps
        for place in np.flatnonzero((pos < self.lowest_pos) | (pos > self.highest_pos)):
            raise Fault(
                f"dry run: the policy would ask {self.joints.names[place]} for {pos[place]:.3f} in the mean: expected "
                f"{self.lowest_pos[place]:.3f} to {self.highest_pos[place]:.3f}"
            )


class HeardRobot:
    """A robot that is read, and sent nothing: it may stand under another controller meanwhile."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    def read(self) -> Measurement | None:
        """Return the newest measurement, or None before the first."""
        return self.robot.read()

    def write(self, command: JointCommand) -> None:
        """Send nothing."""

    def close(self) -> None:
        """End the connection."""
        self.robot.close()
