"""A simulated robot for the loop of an exported folder, in simulated time."""

import numpy as np

from ksim_rl.export.standalone.dry_run import DryRun
from ksim_rl.export.standalone.loop import run_loop
from ksim_rl.export.standalone.robot_link import Measurement
from ksim_rl.export.standalone.safety import Limits
from ksim_rl.export.standalone.states import StateMachine, Times

PERIOD = 0.02
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
TIMES = Times(stand_seconds=0.4, blend_seconds=0.2, stop_seconds=0.2, damp_seconds=0.1)


class Clock:
    """Time that passes only in waits."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep_until(self, deadline):
        self.time = max(self.time, deadline)


class Bench:
    """A robot on a bench: joints go where they are asked to, and nothing falls. `harm` spoils what it reads."""

    def __init__(self, clock):
        self.clock = clock
        self.pos = np.array([0.9, -1.4])
        self.vel = np.zeros(2)
        self.commands = []
        self.harm = lambda measurement: measurement
        self.write_fails = False
        # Of the gyroscope, which is never the same twice.
        self.noise = np.random.default_rng(8)

    def read(self):
        return self.harm(
            Measurement(
                stamp=self.clock.now(),
                joint_pos=self.pos.copy(),
                joint_vel=self.vel.copy(),
                joint_effort=np.zeros(2),
                root_quat=UPRIGHT,
                root_ang_vel=1e-3 * self.noise.normal(size=3),
                estimates={"sensor": np.zeros(3)},
            )
        )

    def write(self, command):
        if self.write_fails:
            raise OSError("the cable is out")
        self.commands.append(command)
        # As in honey: the speed follows the pull.
        self.vel = command.stiffness * (command.pos - self.pos) / 3.0
        self.pos = self.pos + PERIOD * self.vel

    def close(self):
        pass


class Lines:
    """A log in memory."""

    def __init__(self):
        self.events = []
        self.states = []
        self.asked = []

    def period(self, now, state, measurement, command, asked):
        self.states.append(state)
        self.asked.append(asked)

    def event(self, now, text):
        self.events.append(text)


class Script:
    """Says words at times."""

    def __init__(self, **at):
        self.left = sorted((time, word) for word, time in at.items())

    def words(self, now, machine):
        found = [word for time, word in self.left if time <= now + 1e-9]
        self.left = self.left[len(found) :]
        return found


def set_up(control, *, limits=None, times=TIMES, dry_seconds=None):
    """Return a clock, a robot, a machine and its log; the policy runs dry where `dry_seconds` says for how long."""
    clock = Clock()
    lines = Lines()
    limits = limits or Limits()
    dry = None
    if dry_seconds is not None:
        margin = limits.position_margin
        dry = DryRun(control, period=PERIOD, seconds=dry_seconds, margin=margin, clock=clock.now)
    machine = StateMachine(
        control, period=PERIOD, limits=limits, times=times, note=lines.event, dry=dry
    )
    robot = Bench(clock)
    robot.lines = lines
    return clock, robot, machine, lines


def run(clock, robot, machine, lines, *operators):
    return run_loop(robot, machine, operators, lines, clock=clock, period=PERIOD)
