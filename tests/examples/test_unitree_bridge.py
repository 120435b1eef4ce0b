"""The bridge to Unitree's robots speaks their messages, and brakes when they end; the other side is the stub."""

import dataclasses
import json
import struct
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="needs DDS: pip install cyclonedds")
pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.standalone import loop, robot_link
from ksim_rl.export.standalone.deadlines import MonotonicClock
from ksim_rl.export.standalone.policy_control import PolicyControl
from ksim_rl.export.standalone.safety import Limits
from ksim_rl.export.standalone.simulated_robot import SimulatedRobot
from ksim_rl.export.standalone.states import State, StateMachine, Times
from ksim_rl.export.standalone.words import Unattended
from tests.export.toy_folder import toy_folder

BRIDGE = Path(__file__).parents[2] / "examples" / "bridges" / "unitree"
sys.path.insert(0, str(BRIDGE))

from unitree_bridge.checksum import checksum, crc32_mpeg2  # noqa: E402
from unitree_bridge.robot import UnitreeRobot  # noqa: E402
from unitree_bridge.robots import G1, GO2, zeros  # noqa: E402
from unitree_bridge.stub import Stub  # noqa: E402

# Sizes of the C structs of the SDK, in bytes.
SIZES = {"go2": (812, 1180), "g1": (1004, 2092)}
# Where the first motor of a command begins on the wire.
FIRST_MODE = {"go2": 22, "g1": 2}
DOMAIN = 77


def bit_by_bit(words):
    """Return the checksum as the polynomial says it."""
    found = 0xFFFFFFFF
    for word in words:
        for place in range(31, -1, -1):
            first = found >> 31
            found = (found << 1) & 0xFFFFFFFF
            if first ^ (word >> place & 1):
                found ^= 0x04C11DB7
    return found


def test_the_checksum_is_that_of_its_definition():
    # The check value of CRC-32/MPEG-2 in catalogues.
    assert crc32_mpeg2(b"123456789") == 0x0376E6E7


@pytest.mark.parametrize("kind", [GO2, G1], ids=lambda kind: kind.name)
def test_messages_have_the_layout_of_the_sdk(kind):
    command = kind.command()
    draws = np.random.default_rng(3)
    for motor in command.motor_cmd:
        motor.mode = 1
        motor.q, motor.dq, motor.tau, motor.kp, motor.kd = draws.normal(size=5).tolist()
    command.reserve = 7 if kind is GO2 else [7, 8, 9, 10]
    command.crc = checksum(command, kind.layout)
    content = command.serialize()[4:]
    state = zeros(kind.messages.LowState).serialize()[4:]
    # Over the wire the first motor's mode follows without the padding that C puts before and behind it.
    mode = FIRST_MODE[kind.name]
    in_c = b"".join(
        (content[:mode], bytes(2), content[mode : mode + 1], bytes(3), content[mode + 2 :])
    )
    assert (len(in_c), len(state) + 4) == SIZES[kind.name]
    words = struct.unpack(f"<{len(in_c) // 4}I", in_c)
    assert command.crc == words[-1] == bit_by_bit(words[:-1])


def test_motors_stand_in_the_order_of_the_sdk():
    assert [
        GO2.joints.index(name) for name in ("FR_hip_joint", "FL_calf_joint", "RL_calf_joint")
    ] == [0, 5, 11]
    places = {"left_knee_joint": 3, "right_ankle_roll_joint": 11, "waist_pitch_joint": 14}
    places |= {
        "left_shoulder_pitch_joint": 15,
        "left_wrist_yaw_joint": 21,
        "right_wrist_yaw_joint": 28,
    }
    assert {name: G1.joints.index(name) for name in places} == places and len(G1.joints) == 29


class Module:
    """The names of an exported folder's `loop.py` and `runner.py` that the bridge asks for."""

    Measurement = robot_link.Measurement
    JointCommand = robot_link.JointCommand
    SimulatedRobot = SimulatedRobot


class Lines:
    """A log in memory."""

    def __init__(self):
        self.events = []

    def period(self, now, state, measurement, command, asked):
        self.state = state

    def event(self, now, text):
        self.events.append(text)


@pytest.fixture
def pair(tmp_path):
    """A bridge and a stub of the toy's two joints, in another order than the policy's, and what runs the stub."""
    folder = toy_folder(tmp_path)
    meta = json.loads((folder / "export.json").read_text())
    # By the name that tells the bridge what it measures.
    for node in meta["obs"]["measurements"]:
        if node["quantity"] == "sensor":
            assert node["sensor"] == "imu_ang_vel"
    kind = dataclasses.replace(GO2, joints=("left", "right"))
    stub = Stub(kind, Module, folder, interface="lo", domain=DOMAIN)
    robot = UnitreeRobot(kind, Module, meta, interface="lo", domain=DOMAIN)
    stops = threading.Event()

    def run():
        while not stops.wait(stub.period):
            stub.step()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield PolicyControl(folder, meta), robot, stub, stops
    stops.set()
    thread.join()


def test_the_loop_runs_over_the_network_and_brakes_when_messages_end(pair):
    control, robot, stub, stops = pair
    clock = MonotonicClock()
    first = loop.first_measurement(robot, clock, 0.02)
    assert first.joint_pos == pytest.approx([-0.2, 0.3], abs=1e-6)
    assert control.lacking(first) == []
    lines = Lines()
    limits = Limits(most_tilt=4.0, position_margin=9.0, most_speed=1e3, late_periods=10.0)
    times = Times(stand_seconds=0.1, damp_seconds=0.2, blend_seconds=0.1)
    machine = StateMachine(control, period=0.02, limits=limits, times=times, note=lines.event)
    machine.watch.most_speed[:] = 1e3

    class Cable:
        def words(self, now, machine):
            if machine.state is State.POLICY and now - machine.since > 0.3:
                stops.set()
            return []

    loop.run_loop(
        robot, machine, [Unattended(9.0), robot, Cable()], lines, clock=clock, period=0.02
    )
    assert [event.split(":")[0] for event in lines.events] == [
        "damp -> stand",
        "stand -> policy",
        "policy -> damp",
    ]
    assert "no message from the robot for" in lines.events[-1] and lines.state is State.DAMP
    assert stub.taken > 20 and stub.refused == 0
    # Motor 0 is the left one, which is the second of the policy.
    stub.commands.take(N=16)
    robot.write(
        robot_link.JointCommand(
            pos=np.array([0.1, 0.2]),
            vel=np.zeros(2),
            effort=np.array([-1.0, 1.0]),
            stiffness=np.array([3.0, 4.0]),
            damping=np.array([0.5, 0.6]),
        )
    )
    (message,) = _arrived(stub.commands)
    sent = [(motor.q, motor.tau, motor.kp, motor.kd) for motor in message.motor_cmd[:2]]
    assert np.array(sent) == pytest.approx(np.array([(0.2, 1.0, 4.0, 0.6), (0.1, -1.0, 3.0, 0.5)]))
    assert [motor.mode for motor in message.motor_cmd[:3]] == [1, 1, 0]
    message.crc ^= 1
    robot.commands.write(message)
    until = time.monotonic() + 2.0
    while not stub.refused and time.monotonic() < until:
        stub.step()
    assert stub.refused == 1
    # The reader sees that the sender goes away, which is no measurement.
    newest = robot.read()
    del stub.states
    until = time.monotonic() + 0.3
    while time.monotonic() < until:
        assert robot.read() is newest


def _arrived(reader):
    until = time.monotonic() + 2.0
    while time.monotonic() < until:
        if found := reader.take(N=16):
            return found
    return []


def test_buttons_of_the_remote_are_words_once_each(pair):
    _, robot, stub, _ = pair
    # Held down before the loop began.
    stub.remote = bytes([0, 0, 1 << 3, *bytes(37)])
    time.sleep(0.1)
    loop.first_measurement(robot, MonotonicClock(), 0.02)
    found = []
    for buttons in (1 << 3, 1 << 2, 1 << 2, 0, 1 << 9 | 1 << 8, 0):
        stub.remote = bytes([0, 0, *buttons.to_bytes(2, "little"), *bytes(36)])
        time.sleep(0.1)
        robot.read()
        robot.read()
        found.append(robot.words(0.0, None))
        # A period without a message lets no button go.
        assert robot.words(0.0, None) == []
    assert found == [[], ["stand"], [], [], ["policy", "damp"], []]


def test_another_robot_is_refused_by_name(tmp_path):
    meta = json.loads((toy_folder(tmp_path) / "export.json").read_text())
    with pytest.raises(ValueError, match="go2 has the joint 'FR_hip_joint', which the policy"):
        UnitreeRobot(GO2, Module, meta, interface="lo", domain=DOMAIN)
    kind = dataclasses.replace(GO2, joints=("left",))
    with pytest.raises(ValueError, match="go2 has no joint 'right'"):
        UnitreeRobot(kind, Module, meta, interface="lo", domain=DOMAIN)
