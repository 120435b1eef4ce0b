"""A log of a stranger is data: what is wrong with it is one line that names the column or the joint, and the fix."""

import numpy as np
import pytest

from ksim_rl.identification.held_robot import hold
from ksim_rl.identification.joint_log import read_log
from tests.identification import hidden

TIME_T = np.arange(3000) / 500.0
WAVE_TN = 0.3 * np.sin(2.0 * np.pi * np.array((0.7, 1.1)) * TIME_T[:, None]) + np.array((0.2, -0.9))


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "leg.xml"
    path.write_text(hidden.MODEL)
    return hold(str(path))


def written(path, time_T=TIME_T, pos_TN=WAVE_TN, targets=None):
    path.write_text(hidden.log_text(time_T, targets or {"pos": WAVE_TN}, pos_TN))
    return path


def test_a_log_comes_back(robot, tmp_path):
    # The stamps of a clock, which count from another moment.
    path = written(
        tmp_path / "a.csv", time_T=TIME_T + 1000.0, targets={"effort": WAVE_TN, "pos": -WAVE_TN}
    )
    text = path.read_text().splitlines()
    path.write_text("\n".join([f"{text[0]},battery", *(f"{line},24.1" for line in text[1:])]))
    log = read_log(path, robot)
    assert log.time_T == pytest.approx(TIME_T, abs=1e-4)
    assert log.pos_TN == pytest.approx(WAVE_TN)
    assert log.targets.by_kind["effort"] == pytest.approx(WAVE_TN)
    assert log.targets.by_kind["pos"] == pytest.approx(-WAVE_TN)
    assert log.unread == ("battery",)


def test_parquet_is_read_like_csv(robot, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    import pyarrow

    lines = written(tmp_path / "a.csv").read_text().splitlines()
    table = np.loadtxt(lines[1:], delimiter=",")
    columns = dict(zip(lines[0].split(","), table.T, strict=True))
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    assert read_log(tmp_path / "a.parquet", robot).pos_TN == pytest.approx(WAVE_TN)
    (tmp_path / "b.parquet").write_bytes(b"PAR1 no table")
    with pytest.raises(ValueError, match="no Parquet file"):
        read_log(tmp_path / "b.parquet", robot)
    parquet.write_table(
        pyarrow.table({**columns, "time": ["x"] * len(table)}), tmp_path / "c.parquet"
    )
    with pytest.raises(ValueError, match="'time' holds something else than numbers"):
        read_log(tmp_path / "c.parquet", robot)


def edited(changes):
    """A log in which cells were changed, as (line, column, value)."""

    def write(path):
        lines = written(path).read_text().splitlines()
        for line, column, value in changes:
            cells = lines[line].split(",")
            cells[column] = value
            lines[line] = ",".join(cells)
        path.write_text("\n".join(lines))

    return write


def faulty(**parts):
    return lambda path: written(path, **parts)


def standing(joint):
    pos_TN = WAVE_TN.copy()
    pos_TN[:, joint] = pos_TN[0, joint]
    return pos_TN


FAULTS = {
    "missing encoder": (
        edited([(0, 2, "kne.position")]),
        "'knee.position'.*joint 'knee'.*kne.position",
    ),
    "missing command": (
        edited([(0, 4, "battery")]),
        "no column 'knee.target_position', though there is",
    ),
    "no commands": (edited([(0, 3, "a"), (0, 4, "b")]), "no column says what was commanded"),
    "no time": (edited([(0, 0, "stamp")]), "no column 'time'"),
    "one name twice": (edited([(0, 2, "hip.position")]), "two columns 'hip.position'"),
    "NaN": (edited([(7, 2, "nan"), (9, 2, "inf")]), r"'knee.position', line 8: nan.*2 of 3000"),
    "a word": (edited([(7, 2, "off")]), "below the header.*'off'"),
    "unsorted": (edited([(10, 0, "0.001")]), "line 11: it does not grow"),
    "a gap": (faulty(time_T=TIME_T + (TIME_T > 2.0)), r"for 1 s after 2 s \(line 1002\)"),
    "milliseconds": (faulty(time_T=1e3 * TIME_T), "'time': 2 between lines: expected seconds"),
    "too short": (faulty(time_T=TIME_T / 2.0), "3 s: expected at least 5 s"),
    "degrees": (
        faulty(pos_TN=np.rad2deg(WAVE_TN)),
        "joint 'hip': readings.*degrees: write radians",
    ),
    "degrees of targets": (
        faulty(targets={"pos": np.rad2deg(WAVE_TN)}),
        "joint 'hip': targets of its position.*degrees: write radians",
    ),
    "another zero": (
        faulty(pos_TN=WAVE_TN + 3.0),
        "joint 'hip': readings.*check its unit, sign and zero",
    ),
    "a joint that stands": (faulty(pos_TN=standing(1)), "joint 'knee' moves by 0 only.*--propose"),
    "a joint without commands": (
        faulty(targets={"pos": standing(0)}),
        "joint 'hip': its commands never change",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_is_said_by_name(robot, tmp_path, fault):
    write, words = FAULTS[fault]
    path = tmp_path / "log.csv"
    write(path)
    with pytest.raises(ValueError, match=words) as caught:
        read_log(path, robot)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_are_refused(robot, tmp_path):
    (tmp_path / "log.db3").write_bytes(b"")
    with pytest.raises(ValueError, match="ends in .csv, .parquet or .mcap"):
        read_log(tmp_path / "log.db3", robot)
    (tmp_path / "log.csv").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="it is no text"):
        read_log(tmp_path / "log.csv", robot)
    with pytest.raises(ValueError, match="missing"):
        read_log(tmp_path / "none.csv", robot)
