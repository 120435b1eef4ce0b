"""Logs in MCAP, as its own libraries write them, are read as the tables that they amount to."""

import io
import json

import pytest

from ksim_rl.identification import mcap_log
from ksim_rl.identification.held_robot import hold
from ksim_rl.identification.joint_log import read_log
from tests.identification import hidden
from tests.identification.test_joint_log import TIME_T, WAVE_TN

writer = pytest.importorskip("mcap.writer", reason="needs the extra: pip install ksim_rl[mcap]")
ros = pytest.importorskip("mcap_ros2.writer")
START_NS = 1_764_000_000_123_456_789
LATE_NS = 700_000
FULL_JOINT_STATE = mcap_log.DEFINITION.decode().replace(
    "string[] name", "# a comment\nstring[] name"
)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robot") / "leg.xml"
    path.write_text(hidden.MODEL)
    return hold(str(path))


def stamps(late_ns=0):
    return [START_NS + late_ns + round(1e9 * time) for time in TIME_T]


def in_json(topics, compression=writer.CompressionType.ZSTD):
    """A file of topics: by name the times and the messages, text or a tree."""
    file = io.BytesIO()
    out = writer.Writer(file, compression=compression)
    out.start()
    for name, (times, messages) in topics.items():
        channel = out.register_channel(name, "json", 0)
        for time, message in zip(times, messages, strict=True):
            data = message if isinstance(message, bytes) else json.dumps(message).encode()
            out.add_message(channel, time, data, time)
    out.finish()
    return file.getvalue()


def rows(values_TN, ending):
    names = [f"{joint}.{ending}" for joint in hidden.JOINTS]
    return [dict(zip(names, row, strict=True)) for row in values_TN.tolist()]


def both(**parts):
    topics = {
        "/sent": (stamps(), rows(-WAVE_TN, "target_position")),
        "/read": (stamps(LATE_NS), rows(WAVE_TN, "position")),
    }
    return topics | {name.replace("_", "/"): part for name, part in parts.items()}


@pytest.mark.parametrize("compression", writer.CompressionType)
def test_json_is_a_table(robot, tmp_path, compression):
    path = tmp_path / "log.mcap"
    path.write_bytes(in_json(both(_battery=(stamps(), [{"voltage": 24.0}] * 3000)), compression))
    log = read_log(path, robot)
    assert log.time_T == pytest.approx(TIME_T, abs=1e-8)
    assert log.pos_TN == pytest.approx(WAVE_TN)
    assert log.targets.by_kind["pos"] == pytest.approx(-WAVE_TN)
    assert log.unread == ("/battery",)


def test_joint_states_of_ros_2_are_a_table(robot, tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        out = ros.Writer(file)
        schema = out.register_msgdef("sensor_msgs/msg/JointState", FULL_JOINT_STATE)
        other = out.register_msgdef("std_msgs/msg/String", "string data")
        # The other way round in the file: the order of joints is each message's own.
        names = list(reversed(hidden.JOINTS))
        for topic, late_ns, sign in (("/joint_commands", 0, -1.0), ("/joint_states", LATE_NS, 1.0)):
            for time, row in zip(stamps(late_ns), sign * WAVE_TN[:, ::-1], strict=True):
                message = {
                    "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "base"},
                    "name": names,
                    "position": row.tolist(),
                    "velocity": [],
                    "effort": [0.5, 0.25] if sign > 0.0 else [],
                }
                out.write_message(topic, schema, message, log_time=time, publish_time=time)
        out.write_message("/said", other, {"data": "hello"}, log_time=START_NS)
        out.finish()
    log = read_log(path, robot)
    assert log.pos_TN == pytest.approx(WAVE_TN)
    assert log.targets.by_kind["pos"] == pytest.approx(-WAVE_TN)
    assert log.effort_TN is not None and (log.effort_TN == (0.25, 0.5)).all()
    assert log.unread == ("/said (std_msgs/msg/String, cdr)",)


def test_a_command_counts_from_the_reading_behind_it(robot, tmp_path):
    path = tmp_path / "log.mcap"
    # The first command comes at the third reading, and the file is not in order.
    sent = {"/sent": (stamps()[2:][::-1], rows(-WAVE_TN, "target_position")[2:][::-1])}
    path.write_bytes(in_json(both() | sent))
    log = read_log(path, robot)
    assert log.pos_TN == pytest.approx(WAVE_TN[2:])
    assert log.targets.by_kind["pos"] == pytest.approx(-WAVE_TN[2:])


def readings(**parts):
    """A file whose readings are other ones."""
    return lambda: in_json(both(_read=(stamps(), parts["rows"])))


def cut():
    return in_json(both())[:5000]


def bomb():
    chunk = b" " * (2 * mcap_log.MOST_CHUNK_BYTES)
    return in_json({"/read": ([0], [chunk])})


NO_NUMBERS = rows(WAVE_TN, "position")[:-1] + [{"hip.position": "far", "knee.position": 0.0}]
OTHER_NAMES = rows(WAVE_TN, "position")[:-1] + [{"hip.position": 0.0}]
FAULTS = {
    "text": (lambda: b"no file", "no MCAP file, or a damaged one"),
    "cut": (cut, "no MCAP file, or a damaged one"),
    "bomb": (bomb, "a chunk of more than 33554432 bytes"),
    "a word": (readings(rows=NO_NUMBERS), r"/read \('hip.position' is no number\)"),
    "other names": (readings(rows=OTHER_NAMES), "/read .*other names than its first one"),
    "no object": (readings(rows=[[1.0]] * 3000), "/read .*no object of numbers"),
    "deep": (readings(rows=[b"[" * 100_000] * 3000), "/read .*recursion"),
    "two readings": (
        lambda: in_json(both(_more=(stamps(), rows(WAVE_TN, "position")))),
        "found /read, /more",
    ),
    "two commands": (
        lambda: in_json(both(_more=(stamps(), rows(WAVE_TN, "target_position")))),
        "/more has a column 'hip.target_position', which is the name of a column of /sent",
    ),
    "a time of its own": (
        readings(rows=[{"time": 0.0, **row} for row in rows(WAVE_TN, "position")]),
        "/read has a column 'time', which is the name of the times",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_wrong_is_said_by_name(robot, tmp_path, fault):
    write, words = FAULTS[fault]
    path = tmp_path / "log.mcap"
    path.write_bytes(write())
    with pytest.raises(ValueError, match=words) as caught:
        read_log(path, robot)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_large_files_are_refused(robot, tmp_path, monkeypatch):
    path = tmp_path / "log.mcap"
    path.write_bytes(in_json(both()))
    monkeypatch.setattr(mcap_log, "MOST_BYTES", 1000)
    with pytest.raises(ValueError, match="more than 1000 bytes once it is unpacked"):
        read_log(path, robot)
