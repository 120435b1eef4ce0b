"""The loop in C++ answers a robot's messages as loop.py does: commands, states, faults, and what is said of them."""

import dataclasses
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")

import onnx

from ksim_rl.export.standalone.dry_run import DryRun
from ksim_rl.export.standalone.files import read_json
from ksim_rl.export.standalone.journal import Journal
from ksim_rl.export.standalone.policy_control import PolicyControl
from ksim_rl.export.standalone.robot_link import DescribedJoints, JointCommand
from ksim_rl.export.standalone.safety import Limits
from ksim_rl.export.standalone.states import StateMachine
from tests.export.loop_bench import PERIOD, TIMES, Bench, Clock, Lines, Script, run

SOURCES = Path(__file__).parents[2] / "examples" / "deploy" / "cpp"
FIELDS = [field.name for field in dataclasses.fields(JointCommand)]
pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")


def build(program, source, *words):
    """Compile a program as docs/deploy.md says, but without optimization, which takes longer than all tests."""
    command = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{SOURCES}", *words]
    done = subprocess.run(
        [*command, "-pthread", "-x", "c++", "-", "-x", "none", "-o", str(program)],
        input=source,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def replay(folder, tmp_path_factory):
    """The program that answers messages; its networks are matrices, which stand beside the files of onnx."""
    _write_matrix(folder / "obs.onnx")
    _write_matrix(folder / "policy.onnx")
    graph = Path(__file__).parent / "linear_graph.cpp"
    # As one source, whose headers are read once.
    source = f'#include "replay.cpp"\n#include "{graph}"\n'
    return build(tmp_path_factory.mktemp("cpp") / "replay", source)


def _write_matrix(path):
    """Write what a graph of the toy is: its inputs side by side, or a matrix of them."""
    graph = onnx.load(path).graph
    inputs = [(port.name, port.type.tensor_type.shape.dim[1].dim_value) for port in graph.input]
    weights = np.eye(sum(size for _, size in inputs))
    if graph.initializer:
        weights = onnx.numpy_helper.to_array(graph.initializer[0])
    lines = [str(len(inputs)), *(f"{name} {size}" for name, size in inputs), str(weights.shape[1])]
    rows = [" ".join(f"{number:.9g}" for number in row) for row in weights]
    path.with_name(f"{path.name}.txt").write_text("\n".join([*lines, *rows]))


class Recorder:
    """An operator who keeps what the others say, and a machine's side of it: messages and answers."""

    def __init__(self, script):
        self.script = script
        self.said = []
        self.messages = []
        self.answers = []

    def words(self, now, machine):
        self.said = self.script.words(now, machine)
        return self.said

    def keep(self, machine):
        tick = machine.tick

        def recorded(now, measurement, words):
            command = tick(now, measurement, words)
            self.messages.append(_message(now, self.said, measurement))
            self.answers.append((machine.state.name.lower(), command))
            return command

        machine.tick = recorded


def _message(now, words, measurement):
    said = ",".join(word.replace(" ", "_") for word in words) or "-"
    fields = [repr(float(now)), said]
    if measurement is None:
        return " ".join([*fields, *"-------"])
    count = "-" if measurement.count is None else str(measurement.count)
    fields += [repr(float(measurement.stamp)), count]
    values = (measurement.joint_pos, measurement.joint_vel, measurement.joint_effort)
    for numbers in (*values, measurement.root_quat, measurement.root_ang_vel):
        fields.append("-" if numbers is None else _listed(numbers))
    for name, numbers in measurement.estimates.items():
        fields.append(f"{name}={_listed(numbers)}")
    return " ".join(fields)


def _listed(numbers):
    return ",".join(repr(float(number)) for number in numbers)


def compare(program, folder, robot_of, script, *, limits=None):
    """Run the loop in Python, give its messages to the program, and return the machine of the loop in Python."""
    limits = limits or Limits()
    control = PolicyControl(folder, read_json(folder / "export.json"))
    clock = Clock()
    lines = Lines()
    dry = DryRun(
        control, period=PERIOD, seconds=0.2, margin=limits.position_margin, clock=clock.now
    )
    machine = StateMachine(
        control, period=PERIOD, limits=limits, times=TIMES, note=lines.event, dry=dry
    )
    recorder = Recorder(script)
    recorder.keep(machine)
    run(clock, robot_of(clock), machine, lines, recorder)
    options = ["--dry-seconds", "0.2"]
    for owner in (limits, TIMES):
        for field in dataclasses.fields(owner):
            if field.name != "dry_seconds":
                value = repr(getattr(owner, field.name))
                options += ["--" + field.name.replace("_", "-"), value]
    done = subprocess.run(
        [str(program), str(folder), *options],
        input="\n".join(recorder.messages) + "\n",
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == int(bool(machine.fault)), done.stderr
    # One clock, by the name that each language has for it.
    said = done.stdout.replace("CLOCK_MONOTONIC", "time.monotonic")
    told = [line.removeprefix("# ") for line in said.splitlines() if line[0] == "#"]
    assert told == lines.events
    answers = [line.split() for line in done.stdout.splitlines() if line[0] != "#"]
    assert len(answers) == len(recorder.answers) > 10
    for found, (state, command) in zip(answers, recorder.answers, strict=True):
        assert found[0] == state
        for text, name in zip(found[1:], FIELDS, strict=True):
            numbers = np.array(text.split(","), float)
            assert numbers == pytest.approx(getattr(command, name), abs=2e-6), (state, name)
    return machine


class Turning(Bench):
    """A robot that turns and leans a little, and counts its states; `spoil` harms what it reads."""

    def __init__(self, clock):
        super().__init__(clock)
        self.spoil = lambda measurement: measurement

    def read(self):
        now = self.clock.now()
        half = 0.1 * np.sin(now)
        quat = np.array([np.cos(half), np.sin(half), 0.0, 0.0])
        turning = np.array([0.2, -0.1, np.cos(now)])
        changes = {"root_quat": quat, "root_ang_vel": turning, "count": round(now / PERIOD)}
        return self.spoil(dataclasses.replace(super().read(), **changes))


def harmed(**fields):
    """Return a robot whose measurements have other fields from half a second of the policy on."""

    def robot_of(clock):
        robot = Turning(clock)

        def harm(measurement):
            if clock.now() < 1.4:
                return measurement
            changes = {}
            for name, make in fields.items():
                changes[name] = make(measurement)
            return dataclasses.replace(measurement, **changes)

        robot.spoil = harm
        return robot

    return robot_of


def lost(clock):
    robot = Turning(clock)
    robot.spoil = lambda measurement: measurement if clock.now() < 1.4 else None
    return robot


WALK = {"stand": 0.3, "policy": 0.95, "1.5 -0.25": 1.2, "stop": 2.0}
FAULTS = {
    "late": (harmed(stamp=lambda _: 1.33), "no message from the robot for"),
    "another clock": (harmed(stamp=lambda m: m.stamp + 9.0), "ahead of the loop"),
    "lost": (lost, "no message from the robot"),
    "one state": (harmed(count=lambda _: 3), "its count is 3"),
    "no gyroscope": (harmed(root_ang_vel=lambda _: None), "no root_ang_vel in a message"),
    "tilted": (harmed(root_quat=lambda _: np.array([0.6, 0.8, 0.0, 0.0])), "tilted by 106"),
    "beyond": (harmed(joint_pos=lambda _: np.array([0.0, -2.9])), "left is at -2.900"),
    "fast": (harmed(joint_vel=lambda _: np.array([0.0, 21.0])), "left moves with 21.0"),
    "not finite": (harmed(joint_vel=lambda _: np.array([np.nan, 0.0])), "joint_vel of right"),
    "no estimate": (harmed(estimates=lambda _: {}), "no sensor in a message"),
    "too few": (harmed(joint_effort=lambda _: np.zeros(1)), "joint_effort has"),
}


def test_a_walk_and_every_fault_are_those_of_loop_py(replay, folder):
    machine = compare(replay, folder, Turning, Script(**WALK))
    assert not machine.fault
    # Too weak for what the policy asks, so that targets move, and brakes are made smaller.
    machine = compare(replay, folder, Turning, Script(**WALK), limits=Limits(effort_share=0.05))
    assert machine.effort_limit.clipped()
    early = Script(**{"stand": 0.1, "policy": 0.3, "0.5": 0.32, "dance": 0.34, "damp": 0.8})
    compare(replay, folder, Turning, early)
    for robot_of, said in FAULTS.values():
        machine = compare(replay, folder, robot_of, Script(**WALK))
        assert said in machine.fault


BROKEN = {
    "0.3,1x": "joint_pos has '1x' in a message: expected a number",
    "0.3,": "joint_pos has the shape (1,): expected (2,)",
    "-": "joint_pos has '-' in a message",
    "0.3,,": "joint_pos has '' in a message",
}


@pytest.mark.parametrize("pos", BROKEN)
def test_a_broken_line_is_no_measurement(replay, folder, pos):
    line = f"0.0 - 0.0 7 {pos} 0,0 0,0 1,0,0,0 0,0,0.1 sensor=0,0,0\n"
    done = subprocess.run(
        [str(replay), str(folder)], input=line, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1 and BROKEN[pos] in done.stdout
    # Motors brake, and hold nothing.
    assert done.stdout.splitlines()[-1].split()[4] == "0,0"


@pytest.fixture(scope="module")
def onnxruntime():
    """The words by which a program finds onnxruntime's header and library."""
    root = os.environ.get("ONNXRUNTIME_ROOT", "")
    if not os.path.exists(f"{root}/include/onnxruntime_c_api.h"):
        pytest.skip("set ONNXRUNTIME_ROOT to a folder with include/onnxruntime_c_api.h and lib")
    return (f"-I{root}/include", f"-L{root}/lib", f"-Wl,-rpath,{root}/lib", "-lonnxruntime")


def with_onnx(program, main, words):
    """Compile a program with the networks of onnxruntime."""
    source = f'#include "{main}"\n#include "onnx_graph.cpp"\n'
    # The library stands behind what needs it.
    return build(program, source, *words[:3], "-Wl,--no-as-needed", words[3])


@pytest.mark.full
def test_networks_of_onnx_give_the_same_commands(onnxruntime, folder, tmp_path):
    program = with_onnx(tmp_path / "replay", "replay.cpp", onnxruntime)
    assert not compare(program, folder, Turning, Script(**WALK)).fault


@pytest.mark.full
def test_the_program_drives_a_robot_and_writes_its_log(onnxruntime, folder, tmp_path):
    program = with_onnx(tmp_path / "loop", "loop.cpp", onnxruntime)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    words = [sys.executable, str(SOURCES / "simulated_robot.py"), str(folder), "--port", port]
    log = tmp_path / "log.csv"
    quick = ("--dry-seconds", "0.2", "--stand-seconds", "0.2", "--damp-seconds", "0.1")
    loose = ("--most-tilt", "4", "--most-speed", "1000", "--position-margin", "9")
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as robot:
        assert "waits on port" in robot.stdout.readline()
        done = subprocess.run(
            [program, folder, "--port", port, "--seconds", "0.5", "--log", log, *quick, *loose],
            input="",
            capture_output=True,
            text=True,
            check=False,
        )
        robot.kill()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "stop -> damp: stopped" in done.stdout
    # The columns of loop.py, whose form `ksim-rl identify` reads.
    joints = DescribedJoints(read_json(folder / "export.json"))
    journal = Journal(tmp_path / "own.csv", joints, print, dry=True)
    journal.close()
    head, *lines = log.read_text().splitlines()
    assert head == (tmp_path / "own.csv").read_text().splitlines()[0]
    rows = np.array([line.split(",") for line in lines if line[0] != "#"], float)
    assert len(rows) > 50 and np.diff(rows[:, 0]) == pytest.approx(PERIOD, abs=0.01)
