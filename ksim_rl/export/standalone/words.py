"""Words of an operator: stand, policy, stop, damp, and numbers of a command."""

import math
import queue
import signal
import threading
from collections.abc import Sequence
from types import FrameType
from typing import Protocol, TextIO

import numpy as np

from ksim_rl.export.standalone.plan_control import PlanControl
from ksim_rl.export.standalone.states import State, StateMachine

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Ctrl-C, kill, a terminal or connection that closes, Ctrl-\\, Ctrl-Z: each would leave the motors as they are."""
OF_THE_TERMINAL = (signal.SIGTTIN, signal.SIGTTOU)
"""By which a system halts a program in the background that uses the terminal."""
REST_S = 1.0
"""With damped motors at the beginning, until a word says more."""


class Operator(Protocol):
    """A source of operator words, which say what comes next."""

    def words(self, now: float, machine: StateMachine) -> list[str]:
        """Return what was said since the last period."""
        ...


class Keyboard:
    """Lines of a terminal: each is a word, or the numbers of a command; an empty line is `stop`.

    The end of lines is `stop`, too, where the keyboard `leads`: no word could stop the robot any more.
    """

    def __init__(self, lines: TextIO | None, *, leads: bool) -> None:
        # Python has None where the program was started without an input.
        self.lines = lines or ()
        self.leads = leads
        self.said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._listen, name="keyboard", daemon=True)
        self.thread.start()

    def _listen(self) -> None:
        try:
            for line in self.lines:
                self.said.put(line.strip() or "stop")
        except ValueError:
            # Bytes that are no text: the operator said something that cannot be read.
            self.said.put("stop")
        except OSError:  # the terminal is gone, or another program has it
            pass
        if self.leads:
            self.said.put("stop")

    def words(self, now: float, machine: StateMachine) -> list[str]:
        """Return what was said since the last period."""
        found = []
        while not self.said.empty():
            found.append(self.said.get())
        return found


class Unattended:
    """Says the words by a timetable: stand after a rest, policy, and stop after some seconds of it."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.began: float | None = None

    def words(self, now: float, machine: StateMachine) -> list[str]:
        """Return the word that leads on from a state that is done."""
        if machine.fault or machine.ends_at < math.inf:
            return []
        if self.began is None:
            self.began = now
        if machine.state is State.DAMP and now - self.began >= REST_S:
            return ["stand"]
        if machine.may_begin(now):
            return ["policy"]
        if machine.state is State.POLICY and now - machine.since >= self.seconds:
            return ["stop"]
        return []


class EndOfPlan:
    """Says `stop` once all lines of a plan were sent."""

    def __init__(self, plan: PlanControl) -> None:
        self.plan = plan

    def words(self, now: float, machine: StateMachine) -> list[str]:
        """Return the word, in the state that follows the plan."""
        return ["stop"] if machine.state is State.POLICY and self.plan.is_over() else []


class EndOfDryRun:
    """Says `stop` once the dry run at the beginning is over."""

    def words(self, now: float, machine: StateMachine) -> list[str]:
        """Return the word, in the state that follows the dry run."""
        if machine.state is State.DAMP and machine.ends_at == math.inf:
            return ["stop"]
        return []


class Interrupts:
    """Makes `stop` of the first interrupt or end that the system sends to this process, and `damp` of the next."""

    def __init__(self) -> None:
        self.count = 0
        self.said = 0

    def listen(self) -> None:
        """Take the place of handlers that would leave the loop, or halt it."""
        for number in STOPS:
            signal.signal(number, self._heard)
        for number in OF_THE_TERMINAL:
            signal.signal(number, signal.SIG_IGN)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.count += 1

    def words(self, now: float, machine: StateMachine) -> list[str]:
        """Return a word for each signal since the last period."""
        found = []
        while self.said < self.count:
            found.append("damp" if self.said else "stop")
            self.said += 1
        return found


def sort_words(said: Sequence[str], machine: StateMachine, now: float) -> list[str]:
    """Return the words of the last lines, and set the policy's first command from lines of numbers."""
    found = []
    for line in said:
        try:
            values = [float(part) for part in line.split()]
        except ValueError:
            found.append(line)
            continue
        commands = machine.control.command
        first = next(iter(commands), None)
        wanted = 0 if first is None else len(commands[first])
        is_finite = all(math.isfinite(value) for value in values)
        if first is None or len(values) != wanted or not is_finite:
            machine.note(now, f"operator: {line!r}: expected {wanted} numbers")
            continue
        allowed = machine.control.ranges[first]
        clipped = allowed.clip(np.array(values))
        # A stick that is held beyond the range says so once.
        if not np.array_equal(clipped, commands[first]):
            beyond = "" if np.array_equal(clipped, values) else f": clipped to {allowed}"
            machine.note(now, f"operator: {first} {line}{beyond}")
        commands[first][:] = clipped
    return found
