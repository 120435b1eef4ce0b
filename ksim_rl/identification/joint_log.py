"""Reads logs of commands and encoders, and refuses those that would be fitted to nonsense.

A log is a table, CSV, Parquet or MCAP, with the column `time` (s) and, for each joint, `<joint>.position` (the encoder,
rad or m) and what was commanded: `<joint>.target_position`, `.target_velocity` and `.target_effort` (rad or m, per
second, N m or N). Each command holds until the next line. `<joint>.effort` is a measured effort, to which actuator
networks are fitted.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ksim_rl.checks import near
from ksim_rl.files.reading import MOST_TEXT_BYTES, read_bytes
from ksim_rl.identification.held_robot import DrivenJoint, HeldRobot
from ksim_rl.identification.mcap_log import read_mcap
from ksim_rl.identification.simulation import Targets
from ksim_rl.scene.state.joint_control import TargetKind

Array = np.ndarray
TIME = "time"
POSITION = "position"
EFFORT = "effort"
TARGET_COLUMNS: Mapping[TargetKind, str] = {
    "pos": "target_position",
    "vel": "target_velocity",
    "effort": "target_effort",
}
MOST_CELLS = 2**26
LEAST_S = 5.0
LONGEST_STEP_S = 0.05
"""Between readings: slower logs do not show what joints do."""
SHORTEST_STEP_S = 1e-5
GAP = 5.0
"""Steps without a reading, from which on the log counts as interrupted."""
LEAST_MOTION = 0.02
"""rad or m: what moves less says nothing of its inertia."""
BEYOND = 0.2
"""Share of a joint's range that readings may lie outside of it; more is another unit."""


@dataclass(frozen=True, kw_only=True)
class JointLog:
    """Commands and encoder readings: positions [T, N], rad or m, at times [T], s."""

    time_T: Float[Array, " T"]
    pos_TN: Float[Array, "T N"]
    targets: Targets
    effort_TN: Float[Array, "T N"] | None = None
    """Measured efforts, N m or N, where the log has them."""
    unread: tuple[str, ...] = ()
    """Columns and topics of the file that are no part of this."""

    def part(self, columns: Sequence[int]) -> "JointLog":
        """Return the log of some of the joints."""
        by_kind: dict[TargetKind, Array] = {}
        for kind, values_TN in self.targets.by_kind.items():
            by_kind[kind] = values_TN[:, columns]
        return JointLog(
            time_T=self.time_T,
            pos_TN=self.pos_TN[:, columns],
            targets=Targets(time_T=self.targets.time_T, by_kind=by_kind),
            effort_TN=None if self.effort_TN is None else self.effort_TN[:, columns],
        )


def read_log(path: Path, robot: HeldRobot) -> JointLog:
    """Read a log of the joints of a robot; a ValueError names the column or joint, and the fix."""
    columns, left_out = _read_columns(path)
    if TIME not in columns:
        raise ValueError(f"{path}: no column {TIME!r} (s): {near(TIME, columns)}")
    time_T = columns[TIME]
    read = {TIME}
    positions = []
    for joint in robot.joint_names:
        name = f"{joint}.{POSITION}"
        if name not in columns:
            raise ValueError(
                f"{path}: no column {name!r} of the encoder of joint {joint!r}: {near(name, columns)}"
            )
        positions.append(columns[name])
        read.add(name)
    by_kind: dict[TargetKind, Array] = {}
    for kind, ending in TARGET_COLUMNS.items():
        values_TN = _of_joints(path, robot, columns, ending)
        if values_TN is not None:
            by_kind[kind] = values_TN
            read.update(f"{joint}.{ending}" for joint in robot.joint_names)
    effort_TN = _of_joints(path, robot, columns, EFFORT)
    if effort_TN is not None:
        read.update(f"{joint}.{EFFORT}" for joint in robot.joint_names)
    if not by_kind:
        wanted = ", ".join(f"{robot.joint_names[0]}.{ending}" for ending in TARGET_COLUMNS.values())
        raise ValueError(
            f"{path}: no column says what was commanded: expected some of {wanted}, ..."
        )
    _check_numbers(path, {name: columns[name] for name in sorted(read)})
    _check_time(path, time_T)
    log = JointLog(
        # From zero, so that stamps of the clock lose no digits.
        time_T=time_T - time_T[0],
        pos_TN=np.stack(positions, axis=1),
        targets=Targets(time_T=time_T - time_T[0], by_kind=by_kind),
        effort_TN=effort_TN,
        unread=(*(name for name in columns if name not in read), *left_out),
    )
    for place, joint in enumerate(robot.joints):
        _check_joint(path, joint, log, place)
    return log


def _of_joints(
    path: Path, robot: HeldRobot, columns: Mapping[str, Float[Array, " T"]], ending: str
) -> Float[Array, "T N"] | None:
    """Return the columns with an ending, of all joints; None where no joint has one."""
    names = [f"{joint}.{ending}" for joint in robot.joint_names]
    given = [name for name in names if name in columns]
    if not given:
        return None
    for name in names:
        if name not in columns:
            raise ValueError(
                f"{path}: no column {name!r}, though there is {given[0]!r}: give it, or zeros"
            )
    return np.stack([columns[name] for name in names], axis=1)


def _read_columns(path: Path) -> tuple[dict[str, Float[Array, " T"]], list[str]]:
    """Return a table's columns of numbers by name, and notes about the rest of the file."""
    data = read_bytes(path, limit=MOST_TEXT_BYTES, follows_links=True)
    if path.suffix == ".mcap":
        return read_mcap(path, data, time=TIME, most_cells=MOST_CELLS)
    if path.suffix == ".parquet":
        return _read_parquet(path, data), []
    if path.suffix == ".csv":
        return _read_csv(path, data), []
    raise ValueError(f"{path}: expected a file that ends in .csv, .parquet or .mcap")


def _read_csv(path: Path, data: bytes) -> dict[str, Float[Array, " T"]]:
    try:
        head, _, body = data.decode().partition("\n")
    except UnicodeDecodeError:
        raise ValueError(f"{path}: it is no text: give a CSV file") from None
    names = [name.strip().strip('"') for name in head.split(",")]
    _check_names(path, names)
    try:
        table_TC = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path}: below the header: {' '.join(str(error).split())}") from None
    if table_TC.shape[1] != len(names):
        raise ValueError(
            f"{path}: {len(names)} names in the header, and {table_TC.shape[1]} columns below it"
        )
    return dict(zip(names, table_TC.T, strict=True))


def _read_parquet(path: Path, data: bytes) -> dict[str, Float[Array, " T"]]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        raise ValueError(
            f"{path}: Parquet files need pyarrow: pip install 'ksim_rl[identify]', or write the log as CSV"
        ) from None
    try:
        file = parquet.ParquetFile(io.BytesIO(data))
        # Before it is unpacked: a small file may claim a large table.
        if file.metadata.num_rows * file.metadata.num_columns > MOST_CELLS:
            raise ValueError(f"{path}: more than {MOST_CELLS} numbers")
        table = file.read()
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(f"{path}: no Parquet file: {' '.join(str(error).split())}") from None
    _check_names(path, table.column_names)
    columns = {}
    for name in table.column_names:
        try:
            columns[name] = table[name].to_numpy().astype(np.float64)
        except (ValueError, TypeError, pyarrow.ArrowException):
            raise ValueError(f"{path}: column {name!r} holds something else than numbers") from None
    return columns


def _check_names(path: Path, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path}: two columns {name!r}: expected one")


def _check_numbers(path: Path, columns: Mapping[str, Float[Array, " T"]]) -> None:
    for name, column_T in columns.items():
        bad = np.flatnonzero(~np.isfinite(column_T))
        if bad.size:
            raise ValueError(
                f"{path}: column {name!r}, line {bad[0] + 2}: {column_T[bad[0]]}, which is no finite number: cut "
                f"these lines out ({bad.size} of {len(column_T)})"
            )


def _check_time(path: Path, time_T: Float[Array, " T"]) -> None:
    step_T = np.diff(time_T)
    if len(time_T) < 2 or (step_T <= 0.0).any():
        line = int(np.argmax(step_T <= 0.0)) + 3 if len(time_T) > 1 else 2
        raise ValueError(
            f"{path}: column {TIME!r}, line {line}: it does not grow: sort the lines by time, each once"
        )
    step_s = float(np.median(step_T))
    if not SHORTEST_STEP_S <= step_s <= LONGEST_STEP_S:
        raise ValueError(
            f"{path}: column {TIME!r}: {step_s:g} between lines: expected seconds, and a reading each "
            f"{SHORTEST_STEP_S:g} to {LONGEST_STEP_S:g} s"
        )
    widest = int(step_T.argmax())
    if step_T[widest] > GAP * step_s:
        raise ValueError(
            f"{path}: nothing was logged for {step_T[widest]:.3g} s after {time_T[widest]:g} s (line {widest + 2}): "
            "give the part before or the part behind"
        )
    if time_T[-1] - time_T[0] < LEAST_S:
        raise ValueError(
            f"{path}: {time_T[-1] - time_T[0]:.3g} s: expected at least {LEAST_S:g} s, better 60 s"
        )


def _check_joint(path: Path, joint: DrivenJoint, log: JointLog, place: int) -> None:
    """Refuse readings and commands of a joint that are of another unit, or that say nothing of it."""
    low, high = joint.range
    asked_TN = log.targets.by_kind.get("pos")
    for what, values_TN in (("readings", log.pos_TN), ("targets of its position", asked_TN)):
        if values_TN is None or not np.isfinite(high - low):
            continue
        values_T = values_TN[:, place]
        room = BEYOND * (high - low)
        # Targets push against a limit, so that only readings must lie within it.
        if what != "readings":
            room = high - low
        if values_T.min() < low - room or values_T.max() > high + room:
            found = f"{values_T.min():.3g} to {values_T.max():.3g}"
            fix = "check its unit, sign and zero"
            in_radians_T = np.deg2rad(values_T)
            fits = low - room <= in_radians_T.min() and in_radians_T.max() <= high + room
            # Small numbers would fit, too, and are rather off by their zero.
            if fits and np.abs(values_T).max() > 2.0 * np.pi:
                fix = "they look like degrees: write radians"
            raise ValueError(
                f"{path}: joint {joint.name!r}: {what} from {found}, where its range is {low:.3g} to {high:.3g}: {fix}"
            )
    motion = float(np.ptp(log.pos_TN[:, place]))
    if motion < LEAST_MOTION:
        raise ValueError(
            f"{path}: joint {joint.name!r} moves by {motion:.2g} only, which identifies nothing: move it as "
            "`ksim-rl identify --propose` does"
        )
    asked = [
        kind for kind, values_TN in log.targets.by_kind.items() if np.ptp(values_TN[:, place]) > 0.0
    ]
    if not asked:
        raise ValueError(
            f"{path}: joint {joint.name!r}: its commands never change: move it by commands"
        )
    if joint.nominal["stiffness"] == 0.0 and asked == ["pos"]:
        raise ValueError(
            f"{path}: joint {joint.name!r} has commands of its position, and its motor in the robot's files no "
            "stiffness: give a robot with servos, or the commands of its effort"
        )
