"""The loop: at each deadline read the robot, ask the state machine, write the command, and log it."""

import gc
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from ksim_rl.export.standalone.deadlines import Punctuality, next_deadline
from ksim_rl.export.standalone.journal import Journal
from ksim_rl.export.standalone.robot_link import Measurement, Robot
from ksim_rl.export.standalone.states import StateMachine, in_one_line
from ksim_rl.export.standalone.words import Operator, sort_words

WAIT_S = 5.0
"""For the first message of a robot."""
PRIORITY = 20
"""Of the loop's thread among threads of real time, 1 to 99."""


class Clock(Protocol):
    """A clock that tells the time, s, and waits."""

    def now(self) -> float:
        """Return the time."""
        ...

    def sleep_until(self, deadline: float) -> None:
        """Return at a time, or at once where it has passed."""
        ...


def first_measurement(robot: Robot, clock: Clock, period: float) -> Measurement:
    """Wait for a robot's first message, and return it; a ValueError says that there is none."""
    until = clock.now() + WAIT_S
    while clock.now() < until:
        measurement = robot.read()
        if measurement is not None:
            return measurement
        clock.sleep_until(clock.now() + period)
    raise ValueError(
        f"no message from the robot in {WAIT_S:g} s: is it on, and is it this network?"
    )


@contextmanager
def damping_after(what: str, machine: StateMachine, clock: Clock) -> Iterator[None]:
    """Make a fault of whatever others' code raises, an exit of the program too: motors would stay as they are."""
    try:
        yield
    except BaseException as error:
        machine.fail(clock.now(), f"{what}: {in_one_line(error)}")


def run_loop(
    robot: Robot,
    machine: StateMachine,
    operators: Sequence[Operator],
    journal: Journal,
    *,
    clock: Clock,
    period: float,
) -> Punctuality:
    """Run a robot until the motors are damped at the end, and return how punctual that was."""
    punctuality = Punctuality()
    longest = machine.watch.longest
    deadline = clock.now()
    while True:
        clock.sleep_until(deadline)
        woken = clock.now()
        if woken - deadline > longest:
            machine.fail(
                woken, f"the loop ran {woken - deadline:.3f} s late: is the computer busy?"
            )
        measurement = None
        words: list[str] = []
        with damping_after("read", machine, clock):
            measurement = robot.read()
        with damping_after("operator", machine, clock):
            said = [word for operator in operators for word in operator.words(woken, machine)]
            words = sort_words(said, machine, woken)
        command = machine.tick(woken, measurement, words)
        sent = clock.now()
        with damping_after("write", machine, clock):
            robot.write(command)
        with damping_after("log", machine, clock):
            journal.period(woken, machine.state, measurement, command, machine.asked)
        punctuality.add(deadline, woken, sent)
        if machine.is_over(sent):
            return punctuality
        done = clock.now()
        if done - woken > longest:
            machine.fail(done, f"a period took {done - woken:.3f} s: is the computer busy?")
        deadline, missed = next_deadline(deadline, period, done)
        punctuality.missed += missed


def calm_python() -> None:
    """Avoid late periods: turn off the garbage collector and long turns of other threads."""
    gc.collect()
    # The loop makes no circles of references, so that nothing is left for the collector.
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(1e-4)


def ask_for_real_time() -> str:
    """Ask the system to run this thread before others; return a line that says whether it does."""
    if sys.platform != "linux":
        return "no real-time priority: only Linux is asked for it"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return f"no real-time priority: {error}"
    return f"real-time priority {PRIORITY}"
