"""Reads logs in MCAP (https://mcap.dev/spec) as tables: messages in JSON, and ROS 2's `sensor_msgs/msg/JointState`.

A message in JSON is an object of numbers, whose names are the table's columns. Joint states of a topic with "command"
or "target" in its name are commands, others are readings. A line of the table is a message of readings; of other topics
it takes the last message before it, as a robot would. Times are those at which messages were logged.
"""

import dataclasses
import io
import json
import struct
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from mcap.records import McapRecord

Array = np.ndarray
MOST_CHUNK_BYTES = 2**25
"""Of a part of the file once it is unpacked: a small file may claim to hold a large one."""
MOST_BYTES = 2**30
"""Of all parts."""
JOINT_STATE = "sensor_msgs/msg/JointState"
# The fields of the message as ROS 2 defines it, so that no definition of a stranger's file is read.
DEFINITION = b"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
COMMANDS = ("command", "target")
COMMAND_ENDINGS = (".target_position", ".target_velocity", ".target_effort")
NANOSECONDS = 1e-9
_UNREADABLE = (ValueError, OverflowError, RuntimeError, IndexError, struct.error)

Row = dict[str, float]
Decoder = Callable[[bytes], Row]


@dataclass(kw_only=True)
class Topic:
    """The messages of one topic as a table: times, ns, and for each the numbers of all `names`.

    Attributes:
        reason: why it is no table; empty for one that is.
    """

    name: str
    decode: Decoder
    names: tuple[str, ...] = ()
    times: list[int] = field(default_factory=list)
    numbers: array = field(default_factory=lambda: array("d"))
    reason: str = ""

    def add(self, time: int, data: bytes) -> None:
        """Add a message; a topic with one that is no row like its first one is no table."""
        if self.reason:
            return
        try:
            row = self.decode(data)
        except _UNREADABLE as error:
            self.reason = _line(error)
            return
        if not self.times:
            self.names = tuple(row)
        if row.keys() != set(self.names):
            self.reason = "its messages have other names than its first one"
            return
        self.times.append(time)
        self.numbers.extend(row[name] for name in self.names)

    def has(self, *endings: str) -> bool:
        """Return whether a name ends so."""
        return any(name.endswith(endings) for name in self.names)

    def table(self, first: int) -> tuple[Float[Array, " T"], Float[Array, "T C"]]:
        """Return the times since `first`, s, and the numbers, both in the order of time."""
        time_T = np.array([time - first for time in self.times]) * NANOSECONDS
        # A file need not be in order.
        order_T = np.argsort(time_T, kind="stable")
        numbers_TC = np.array(self.numbers).reshape(len(time_T), len(self.names))
        return time_T[order_T], numbers_TC[order_T]


def read_mcap(
    path: Path, data: bytes, *, time: str, most_cells: int
) -> tuple[dict[str, Float[Array, " T"]], list[str]]:
    """Return the columns of a log by their names, with the time in `time`, and the topics that have no part in it.

    A ValueError says that the file is damaged, or which topics do not make a table of at most `most_cells` numbers.
    """
    topics = _topics(path, data, most_cells)
    tables = [topic for topic in topics if topic.names and not topic.reason]
    left_out = [
        f"{topic.name} ({topic.reason or 'empty'})" for topic in topics if topic not in tables
    ]
    readings = [topic for topic in tables if topic.has(".position")]
    if len(readings) != 1:
        found = ", ".join(topic.name for topic in readings) or "none"
        raise ValueError(
            f"{path}: expected one topic with readings <joint>.position, in JSON or {JOINT_STATE}: found {found}; left "
            f"out: {', '.join(left_out) or 'none'}"
        )
    (own,) = readings
    joined = [own]
    for topic in tables:
        if topic.has(*COMMAND_ENDINGS, ".effort") and topic is not own:
            joined.append(topic)
        elif topic is not own:
            left_out.append(topic.name)
    _check_names(path, time, joined)
    first = min(own.times)
    time_T, _ = own.table(first)
    columns = {time: time_T}
    told_T = np.ones(len(time_T), dtype=bool)
    for topic in joined:
        sent_S, values_SC = topic.table(first)
        last_T = np.searchsorted(sent_S, time_T, side="right") - 1
        # Before its first message its value is unknown.
        told_T &= last_T >= 0
        for name, column_S in zip(topic.names, values_SC.T, strict=True):
            columns[name] = column_S[last_T]
    return {name: column_T[told_T] for name, column_T in columns.items()}, left_out


def _check_names(path: Path, time: str, topics: Sequence[Topic]) -> None:
    owners = {time: "the times at which messages were logged"}
    for topic in topics:
        for name in topic.names:
            if name in owners:
                raise ValueError(
                    f"{path}: {topic.name} has a column {name!r}, which is the name of {owners[name]}: expected one"
                )
            owners[name] = f"a column of {topic.name}"


def _topics(path: Path, data: bytes, most_cells: int) -> list[Topic]:
    """Return the topics of a file with all their messages."""
    try:
        from mcap import exceptions, records
    except ImportError:
        raise ValueError(
            f"{path}: MCAP files need a reader: pip install 'ksim_rl[mcap]', or write the log as CSV"
        ) from None
    schemas: dict[int, str] = {}
    topics: dict[int, Topic] = {}
    cells = 0
    try:
        for record in _records(path, data):
            if isinstance(record, records.Schema):
                schemas[record.id] = record.name
            elif isinstance(record, records.Channel) and record.id not in topics:
                schema = schemas.get(record.schema_id, "")
                decode = _decoder(record.topic, record.message_encoding, schema)
                topics[record.id] = Topic(name=record.topic, decode=decode)
            elif isinstance(record, records.Message):
                topic = topics[record.channel_id]
                topic.add(record.log_time, record.data)
                # Messages that say nothing take time, too.
                cells += max(len(topic.names), 1)
            if cells > most_cells:
                raise ValueError(f"{path}: more than {most_cells} numbers")
    except (exceptions.McapError, struct.error, UnicodeDecodeError, KeyError) as error:
        raise ValueError(f"{path}: no MCAP file, or a damaged one: {_line(error)}") from None
    return list(topics.values())


def _records(path: Path, data: bytes) -> Iterator["McapRecord"]:
    """Yield the file's records, the records of its chunks too."""
    from mcap import records
    from mcap.stream_reader import StreamReader, breakup_chunk

    total = 0
    for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
        if not isinstance(record, records.Chunk):
            yield record
            continue
        unpacked = _unpacked(path, record.compression, record.data)
        total += len(unpacked)
        if total > MOST_BYTES:
            raise ValueError(f"{path}: more than {MOST_BYTES} bytes once it is unpacked")
        yield from breakup_chunk(dataclasses.replace(record, compression="", data=unpacked))


def _unpacked(path: Path, compression: str, data: bytes) -> bytes:
    """Return the bytes of a chunk, up to a limit."""
    import lz4.frame
    import zstandard

    try:
        if compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                found = reader.read(MOST_CHUNK_BYTES + 1)
        elif compression == "lz4":
            found = lz4.frame.LZ4FrameDecompressor().decompress(data, MOST_CHUNK_BYTES + 1)
        elif compression == "":
            found = data
        else:
            raise ValueError(f"{path}: compression {compression!r}: expected zstd, lz4 or none")
    except (zstandard.ZstdError, RuntimeError) as error:
        raise ValueError(f"{path}: a damaged MCAP file: {error}") from None
    if len(found) > MOST_CHUNK_BYTES:
        raise ValueError(
            f"{path}: a chunk of more than {MOST_CHUNK_BYTES} bytes once it is unpacked"
        )
    return found


def _decoder(topic: str, encoding: str, schema: str) -> Decoder:
    """Return the reader of a topic's messages."""
    if encoding == "json":
        return _from_json
    if encoding == "cdr" and schema == JOINT_STATE:
        is_command = any(word in topic.lower() for word in COMMANDS)
        return _joint_state_decoder("target_" if is_command else "")

    def refuse(_: bytes) -> Row:
        raise ValueError(f"{schema or 'no schema'}, {encoding or 'no encoding'}")

    return refuse


def _from_json(data: bytes) -> Row:
    found = json.loads(data)
    if not isinstance(found, Mapping):
        raise ValueError("a message is no object of numbers")
    row = {}
    for name, value in found.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f"{name!r} is no number")
        row[name] = float(value)
    return row


def _joint_state_decoder(prefix: str) -> Decoder:
    """Return the reader of joint states, whose names get a prefix of their kinds."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    schema = Schema(id=1, name=JOINT_STATE, encoding="ros2msg", data=DEFINITION)
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None

    def row_of(data: bytes) -> Row:
        message = decode(data)
        row = {}
        for kind in ("position", "velocity", "effort"):
            values = getattr(message, kind)
            # A kind that the robot does not know is left empty.
            if not values:
                continue
            if len(values) != len(message.name):
                raise ValueError(f"{len(message.name)} names, and {len(values)} of {kind}")
            for name, value in zip(message.name, values, strict=True):
                row[f"{name}.{prefix}{kind}"] = value
        return row

    return row_of


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
