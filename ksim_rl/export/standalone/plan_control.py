"""Follows the commands that `ksim-rl identify --propose` wrote, in the place of a policy."""

import io
from pathlib import Path

import numpy as np

from ksim_rl.export.standalone.commands import CommandRange
from ksim_rl.export.standalone.description import Export
from ksim_rl.export.standalone.files import Array, Json, check_seconds, read
from ksim_rl.export.standalone.robot_link import DescribedJoints, JointCommand, Measurement

TARGETS = {"pos": "target_position", "vel": "target_velocity", "effort": "target_effort"}
UNEVEN_S = 1e-4
"""By which steps of a plan may differ."""


class PlanControl:
    """Commands of joints from a table, a line for each period; a robot stands up to the first one."""

    def __init__(self, meta: Export, path: Path) -> None:
        self.joints = DescribedJoints(meta)
        self.pictures: list[Json] = []
        self.command: dict[str, Array] = {}
        self.ranges: dict[str, CommandRange] = {}
        columns = _columns(path)
        time = columns.get("time", np.zeros(0))
        steps = np.diff(time)
        if len(time) < 2 or not steps.min() > 0.0 or np.ptp(steps) > UNEVEN_S:
            raise ValueError(f"{path}: column 'time': expected at least two lines at an even rate")
        self.period = check_seconds(f"{path}: a step of 'time'", float(np.median(steps)))
        still = np.zeros(len(self.joints.names))
        # What has no target of its position holds the pose of standing.
        absent = {"pos": self.joints.default_pos, "vel": still, "effort": still}
        self.targets = {}
        for kind, otherwise in absent.items():
            self.targets[kind] = self._of_joints(path, columns, TARGETS[kind], otherwise)
        self.joints.default_pos = self.targets["pos"][0]
        self.num_lines = len(time)
        self.begin()

    def _of_joints(
        self, path: Path, columns: dict[str, Array], ending: str, otherwise: Array
    ) -> Array:
        """Return the targets of a kind [T, N], `otherwise` of joints without; all driven joints have them, or none."""
        found = np.tile(otherwise, (len(columns["time"]), 1))
        given = [name for name in self.joints.names if f"{name}.{ending}" in columns]
        for name in given:
            found[:, self.joints.names.index(name)] = columns[f"{name}.{ending}"]
        for place in np.flatnonzero(self.joints.driven):
            name = self.joints.names[place]
            if given and name not in given:
                raise ValueError(f"{path}: no column {name}.{ending}, though other joints have one")
        return found

    def begin(self) -> None:
        """Begin with the first line."""
        self.steps = 0

    def is_over(self) -> bool:
        """Whether all lines were sent."""
        return self.steps >= self.num_lines

    def lacking(self, measurement: Measurement) -> list[str]:
        """Return nothing: a plan observes nothing."""
        return []

    def __call__(self, measurement: Measurement) -> JointCommand:
        """Return the command of the next line, and of the last one behind the end."""
        line = min(self.steps, self.num_lines - 1)
        self.steps += 1
        return JointCommand(
            pos=self.targets["pos"][line],
            vel=self.targets["vel"][line],
            effort=self.targets["effort"][line],
            stiffness=self.joints.stiffness,
            damping=self.joints.damping,
        )


def _columns(path: Path) -> dict[str, Array]:
    """Return the columns of a table of numbers."""
    try:
        head, _, body = read(path).decode().partition("\n")
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path}: no table of numbers: {' '.join(str(error).split())}") from None
    names = head.strip().split(",")
    if table.shape[1] != len(names) or not np.isfinite(table).all():
        raise ValueError(f"{path}: expected {len(names)} finite numbers in each line")
    return dict(zip(names, table.T, strict=True))
