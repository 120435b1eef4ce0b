"""Logs a loop in the form that `ksim-rl identify` reads, from a separate thread."""

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from ksim_rl.export.standalone.files import Array
from ksim_rl.export.standalone.robot_link import (
    DOWN,
    DescribedJoints,
    JointCommand,
    Measurement,
    to_root_axes,
)
from ksim_rl.export.standalone.states import State

MOST_WAITING = 1000
"""Lines that wait for the disk; more are dropped, and counted."""
FLUSH_EVERY_S = 1.0
COLUMNS = (
    "position",
    "velocity",
    "effort",
    "target_position",
    "target_velocity",
    "target_effort",
    "stiffness",
    "damping",
)
DRY_COLUMNS = ("dry_position", "dry_velocity", "dry_effort")
"""Of the policy's targets that were not sent."""

ROOT_COLUMNS = tuple(
    f"{what}.{axis}" for what in ("projected_gravity", "root_ang_vel") for axis in "xyz"
)


class Line(NamedTuple):
    """A line of the log, whose text is made in the thread that writes it."""

    form: str
    values: tuple[float, ...]
    is_event: bool


class Journal:
    """A table of all periods as CSV, and a line with `#` in front for each event.

    Columns are `time` (s since the first period), `state`, `message_age` (s), gravity's direction and the turning of
    the root in its own axes (NaN without a root), and for each joint the `COLUMNS`. Nothing here waits for the disk
    or the terminal: what they cannot take is dropped, and counted in `lost`. Events are shown, too. With `only` it has
    the periods of one state alone. With `dry` it has `DRY_COLUMNS`, too, which are NaN where no dry run is going on.
    """

    def __init__(
        self,
        path: Path,
        joints: DescribedJoints,
        show: Callable[[str], None],
        *,
        only: State | None = None,
        dry: bool = False,
    ) -> None:
        self.path = path
        self.dry = dry
        self.only = only
        self.show = show
        self.lost = 0
        self.failure = ""
        self.started: float | None = None
        names = ["time", "state", "message_age", *ROOT_COLUMNS]
        for joint in joints.names:
            names += [f"{joint}.{column}" for column in COLUMNS]
            if dry:
                names += [f"{joint}.{column}" for column in DRY_COLUMNS]
        self.form = ",".join(["%.6f", "%d", *["%.9g"] * (len(names) - 2)]) + "\n"
        # "x": the log of an earlier run is never written over.
        self.file: TextIO = path.open("x", encoding="utf-8", errors="backslashreplace")
        self.file.write(",".join(names) + "\n")
        self.waiting: queue.SimpleQueue[Line | None] = queue.SimpleQueue()
        self.thread = threading.Thread(target=self._write, name="journal", daemon=True)
        self.thread.start()

    def period(
        self,
        now: float,
        state: State,
        measurement: Measurement | None,
        command: JointCommand,
        asked: JointCommand | None = None,
    ) -> None:
        """Log a period; without a measurement the readings are NaN. `asked` has the targets of a dry run."""
        if self.only not in (None, state):
            return
        if measurement is None:
            unread = np.full(len(command.pos), np.nan)
            readings = (unread, unread, unread)
            age = np.nan
        else:
            readings = (measurement.joint_pos, measurement.joint_vel, measurement.joint_effort)
            age = now - measurement.stamp
        sent = (command.pos, command.vel, command.effort, command.stiffness, command.damping)
        columns = [*readings, *sent]
        if self.dry:
            columns += _dry(command, asked)
        by_joint = np.stack(columns, axis=1)
        root = _of_root(measurement).tolist()
        values = (self._since(now), state.value, age, *root, *by_joint.ravel().tolist())
        self._put(Line(form=self.form, values=values, is_event=False))

    def event(self, now: float, text: str) -> None:
        """Log a line of text."""
        form = "# %.3f s: " + text.replace("%", "%%") + "\n"
        self._put(Line(form=form, values=(self._since(now),), is_event=True))

    def close(self) -> None:
        """Write the queued lines, for at most 5 s."""
        self.waiting.put(None)
        self.thread.join(5.0)

    def _since(self, now: float) -> float:
        if self.started is None:
            self.started = now
        return now - self.started

    def _put(self, line: Line) -> None:
        if self.waiting.qsize() >= MOST_WAITING:
            self.lost += 1
            return
        self.waiting.put(line)

    def _write(self) -> None:
        flushed = time.monotonic()
        try:
            with self.file:
                while (line := self.waiting.get()) is not None:
                    text = line.form % line.values
                    self.file.write(text)
                    if line.is_event:
                        self.show(text.removeprefix("# ").rstrip())
                    if time.monotonic() - flushed > FLUSH_EVERY_S:
                        self.file.flush()
                        flushed = time.monotonic()
        except OSError as error:
            self.failure = f"{self.path}: {error.strerror}"


def _dry(command: JointCommand, asked: JointCommand | None) -> list[Array]:
    """Return the numbers of `DRY_COLUMNS`, NaN where nothing runs dry."""
    if asked is not None:
        return [asked.pos, asked.vel, asked.effort]
    return [np.full(len(command.pos), np.nan)] * len(DRY_COLUMNS)


def _of_root(measurement: Measurement | None) -> Array:
    """Return the numbers of `ROOT_COLUMNS`."""
    found = np.full(len(ROOT_COLUMNS), np.nan)
    if measurement is None:
        return found
    if measurement.root_quat is not None:
        found[:3] = to_root_axes(measurement.root_quat, DOWN)
    if measurement.root_ang_vel is not None:
        found[3:] = measurement.root_ang_vel
    return found
