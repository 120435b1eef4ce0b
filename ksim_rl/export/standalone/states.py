"""The states of a loop: damp, stand up, policy, stop; their motor commands, and the transitions between them."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TypeVar

import numpy as np

from ksim_rl.export.standalone.dry_run import DryRun
from ksim_rl.export.standalone.files import Array
from ksim_rl.export.standalone.picture_watch import PictureWatch
from ksim_rl.export.standalone.robot_link import Control, JointCommand, Measurement
from ksim_rl.export.standalone.safety import (
    EffortLimit,
    Fault,
    Limits,
    Watch,
    check_finite,
    option_of,
)


class State(Enum):
    """The state of a loop; the numbers are the ones in its log."""

    DAMP = 0
    """Motors brake and hold nothing: the beginning, and the end."""
    STAND = 1
    """From the measured pose to the default pose, with growing gains; then hold it."""
    POLICY = 2
    STOP = 3
    """The stiffness fades around the pose at the stop, until motors only brake."""
    DRY = 4
    """Motors brake, and the policy runs on what is measured: the beginning, where there is a dry run."""


# What an operator may ask for, and when. A fault leads to DAMP from everywhere, and nothing leads out of that.
TRANSITIONS = {
    (State.DAMP, "stand"): State.STAND,
    (State.STAND, "policy"): State.POLICY,
    (State.POLICY, "stand"): State.STAND,
    (State.STAND, "stop"): State.STOP,
    (State.POLICY, "stop"): State.STOP,
}
# A pose that is asked for at once is a jump, motors that do not brake let a robot fall, one message may be lost, and
# one step of a policy tells nothing.
LEAST_TIMES = {
    "dry_seconds": 0.1,
    "stand_seconds": 0.1,
    "damp_seconds": 0.1,
    "damping_factor": 0.1,
}
# Arrays, or numbers, between which a hand-over leads.
Between = TypeVar("Between", Array, float)


@dataclass(frozen=True, kw_only=True)
class Times:
    """How long hand-overs last, s, and how strong motors brake.

    Attributes:
        dry_seconds: of the policy's dry runs, at the beginning and when the robot stands.
        stand_seconds: from the measured pose to the default pose.
        blend_seconds: from the pose of standing to the policy's targets.
        stop_seconds: from the gains of the moment to none.
        damp_seconds: of braking at the end, before the program ends.
        damping_factor: damping while motors only brake, of `joint_damping` in export.json.
    """

    dry_seconds: float = 2.0
    stand_seconds: float = 2.0
    blend_seconds: float = 0.5
    stop_seconds: float = 1.0
    damp_seconds: float = 2.0
    damping_factor: float = 2.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            least = LEAST_TIMES.get(field.name, 0.0)
            if not least <= value < math.inf:
                option = option_of(field.name)
                raise ValueError(f"{option} {value:g}: expected {least:g} or more")


class StateMachine:
    """Gives a command of joints for each measurement, and ends in damped motors whatever happens.

    `note` gets a line for each transition, with the time; `state` and `fault` tell where it is. With `dry` the policy
    runs dry before the robot stands up, and once more before it may move the robot; `asked` is what it would have asked
    for in this period.
    """

    def __init__(
        self,
        control: Control,
        *,
        period: float,
        limits: Limits,
        times: Times,
        note: Callable[[float, str], None],
        dry: DryRun | None = None,
    ) -> None:
        self.control = control
        self.dry = dry
        self.asked: JointCommand | None = None
        self.joints = control.joints
        self.times = times
        self.note = note
        self.watch = Watch(self.joints, limits, period)
        self.picture_watch = PictureWatch(control.pictures, limits, period)
        self.effort_limit = EffortLimit(self.joints, limits.effort_share)
        self.state = State.DAMP if dry is None else State.DRY
        self.fault = ""
        self.since = 0.0
        self.ends_at = math.inf
        # What was asked for last: hand-overs begin there.
        self.pose = self.joints.default_pos
        self.share = 0.0
        self.braking = np.where(self.joints.driven, times.damping_factor * self.joints.damping, 0.0)
        # Where a hand-over began.
        self.first_pose = self.pose
        self.first_share = 0.0

    def tick(self, now: float, measurement: Measurement | None, words: list[str]) -> JointCommand:
        """Return the command of this period, s of `time.monotonic`; `words` are an operator's."""
        self.asked = None
        if not self.fault:
            try:
                measured = self.watch.message(now, measurement)
                self.picture_watch(now, measured)
                for word in words:
                    self._obey(now, measured, word)
                # Braking ends what is wrong with these in any case.
                if self.state in (State.STAND, State.POLICY):
                    self.watch.motion(measured)
                command = self._command(now, measured)
                check_finite(command, self.joints.names)
                command = self.effort_limit(command, measured)
                # Once more, as readings of 1e300 may meet there.
                check_finite(command, self.joints.names)
                self.pose = command.pos
                return command
            except Fault as fault:
                self.fail(now, str(fault))
            # Whatever a policy's files make a library raise, an exit too: motors would stay as they are.
            except BaseException as error:
                self.fail(now, in_one_line(error))
        return self._damped(self.pose)

    def fail(self, now: float, why: str) -> None:
        """Damp the motors from now on, and say why, once."""
        if self.fault:
            return
        self.fault = why
        self._enter(now, State.DAMP, f"fault: {why}")
        self.ends_at = now + self.times.damp_seconds

    def is_over(self, now: float) -> bool:
        """Whether the motors have been damped for long enough at the end."""
        return now >= self.ends_at

    def is_standing(self, now: float) -> bool:
        """Whether the default pose has been reached, so that the policy may begin."""
        return self.state is State.STAND and now - self.since >= self.times.stand_seconds

    def may_begin(self, now: float) -> bool:
        """Whether the policy may begin: the robot stands, and the dry run in this pose is over."""
        return self.is_standing(now) and (self.dry is None or self.dry.is_over())

    def _obey(self, now: float, measurement: Measurement, word: str) -> None:
        if word == "damp" or (word == "stop" and self.state in (State.DAMP, State.DRY)):
            self._enter(now, State.DAMP, f"operator: {word}")
            self.ends_at = min(self.ends_at, now + self.times.damp_seconds)
            return
        if word == "stand" and self.state is State.DRY:
            self.note(now, "operator: 'stand' has to wait until the dry run is over")
            return
        to = TRANSITIONS.get((self.state, word))
        # Behind a stop there is the end alone.
        if to is None or self.ends_at < math.inf:
            self.note(now, f"operator: {word!r} leads nowhere from {self.state.name.lower()}")
            return
        if to is State.POLICY and not self.may_begin(now):
            wanted = "the dry run is over" if self.is_standing(now) else "the robot stands"
            self.note(now, f"operator: 'policy' has to wait until {wanted}")
            return
        self.first_share = self.share
        self.first_pose = measurement.joint_pos if self.share == 0.0 else self.pose
        if to is State.POLICY:
            self.control.begin()
        if to is State.STAND and self.dry is not None:
            self.dry.begin()
        self._enter(now, to, f"operator: {word}")

    def _enter(self, now: float, to: State, why: str) -> None:
        self.note(now, f"{self.state.name.lower()} -> {to.name.lower()}: {why}")
        self.state = to
        self.since = now

    def _command(self, now: float, measurement: Measurement) -> JointCommand:
        passed = now - self.since
        if self.state is State.DAMP:
            return self._damped(measurement.joint_pos)
        if self.state is State.DRY:
            self._run_dry(now, measurement, stands=False)
            return self._damped(measurement.joint_pos)
        if self.state is State.STAND:
            if self.is_standing(now):
                self._run_dry(now, measurement, stands=True)
            share = smooth(passed, self.times.stand_seconds)
            pose = between(self.first_pose, self.joints.default_pos, share)
            return self._held(pose, between(self.first_share, 1.0, share))
        if self.state is State.STOP:
            return self._stopping(now, passed)
        asked = self.control(measurement)
        share = smooth(passed, self.times.blend_seconds)
        self.share = 1.0
        pos = between(self.first_pose, asked.pos, share)
        return dataclasses.replace(
            asked, pos=pos, vel=share * asked.vel, effort=share * asked.effort
        )

    def _run_dry(self, now: float, measurement: Measurement, *, stands: bool) -> None:
        """Run one step of the policy without sending its action, and report after the last what it would have sent."""
        if self.dry is None or self.dry.is_over():
            return
        self.asked = self.dry(measurement)
        if not self.dry.is_over():
            return
        for line in self.dry.lines():
            self.note(now, line)
        self.dry.check(stands=stands)
        if self.state is State.DRY:
            self._enter(now, State.DAMP, "the dry run is over")

    def _stopping(self, now: float, passed: float) -> JointCommand:
        share = smooth(passed, self.times.stop_seconds)
        command = self._held(self.first_pose, self.first_share * (1.0 - share))
        if share == 1.0:
            self._enter(now, State.DAMP, "stopped")
            self.ends_at = now + self.times.damp_seconds
        return command

    def _held(self, pose: Array, share: float) -> JointCommand:
        """Return the command that holds a pose with a share of the stiffness, and brakes with the rest."""
        self.share = share
        still = np.zeros(len(pose))
        return JointCommand(
            pos=pose,
            vel=still,
            effort=still,
            stiffness=share * self.joints.stiffness,
            damping=between(self.braking, self.joints.damping, share),
        )

    def _damped(self, pose: Array) -> JointCommand:
        return self._held(pose, 0.0)


def in_one_line(error: BaseException) -> str:
    """Return an error's kind and text."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def smooth(passed: float, seconds: float) -> float:
    """Return how much of a hand-over is done: from 0 to 1, with no speed at both ends."""
    if passed >= seconds:
        return 1.0
    share = passed / seconds
    return share * share * (3.0 - 2.0 * share)


def between(first: Between, last: Between, share: float) -> Between:
    """Interpolate between two values, at a share of the way."""
    return first + share * (last - first)
