"""The loop of an exported folder acts as `runner.py` does, from state to state, by its deadlines."""

import ast
import dataclasses
import io
import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.folder import LOOP_PARTS, PARTS, STANDALONE
from ksim_rl.export.standalone.deadlines import Durations, next_deadline
from ksim_rl.export.standalone.robot_link import JointCommand
from ksim_rl.export.standalone.runner import Runner
from ksim_rl.export.standalone.safety import tilt_of
from ksim_rl.export.standalone.simulated_robot import SimulatedRobot
from ksim_rl.export.standalone.stages import LowPass
from ksim_rl.export.standalone.states import State
from ksim_rl.export.standalone.words import (
    OF_THE_TERMINAL,
    STOPS,
    Interrupts,
    Keyboard,
    Unattended,
    sort_words,
)
from tests.export.loop_bench import (
    PERIOD,
    Bench,
    Clock,
    Script,
    run,
    set_up,
)
from tests.export.toy_folder import DEFAULT

# -- as in training ----------------------------------------------------------------------------------------------


@pytest.fixture
def same_start(folder, control):
    """The loop's robot, and a runner of the same folder at the same state and command."""
    runner = Runner(folder)
    runner.command["twist"] = np.array([0.4, -0.3])
    control.command["twist"] = np.array([0.4, -0.3])
    runner.reset()
    return SimulatedRobot(folder, control.estimated), runner


def test_the_loop_acts_as_the_runner_does(control, same_start):
    robot, runner = same_start
    # A push that turns it, so that axes of the body and the world differ.
    for data in (robot.data, runner.data):
        data.qvel[3:6] = (2.0, -1.5, 1.0)
    robot.runner.refresh()
    runner.refresh()
    runner.frame = runner.observe(advances=False)
    for _ in range(40):
        command = control(robot.read())
        runner.step(runner.act())
        assert control.action == pytest.approx(runner.action, abs=1e-6)
        found = [runner.targets["pos"][name] for name in control.joints.names]
        assert command.pos == pytest.approx(found, abs=1e-6)
        robot.write(command)
        assert robot.data.qpos == pytest.approx(runner.data.qpos, abs=1e-6)
    assert tilt_of(robot.read().root_quat) > 0.2 and abs(runner.action).max() > 0.1


def test_a_motor_exerts_what_the_command_says(folder, control):
    robot = SimulatedRobot(folder, control.estimated)
    robot.runner.decimation = 1
    robot.data.qvel[6:] = (0.5, -0.5)
    before = robot.read()
    command = JointCommand(
        pos=np.array([0.1, 0.2]),
        vel=np.array([0.3, -0.1]),
        effort=np.array([1.5, -2.0]),
        stiffness=np.array([5.0, 7.0]),
        damping=np.array([0.4, 0.2]),
    )
    robot.write(command)
    expected = command.effort + command.stiffness * (command.pos - before.joint_pos)
    expected = expected + command.damping * (command.vel - before.joint_vel)
    assert robot.read().joint_effort == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("parts", [PARTS, LOOP_PARTS], ids=["runner.py", "loop.py"])
def test_no_module_of_a_file_takes_the_names_of_another(parts):
    owners = {}
    for part in parts:
        for node in ast.parse((STANDALONE / f"{part}.py").read_text()).body:
            names = [getattr(node, "name", "")]
            if isinstance(node, ast.Assign):
                names = [ast.unparse(target) for target in node.targets]
            if isinstance(node, ast.AnnAssign):
                names = [ast.unparse(node.target)]
            for name in names:
                assert owners.setdefault(name, part) == part or not name, (name, part)


def test_a_policy_that_the_robot_cannot_observe_is_refused_by_name(control):
    measurement = dataclasses.replace(Bench(Clock()).read(), estimates={}, root_quat=None)
    assert control.lacking(measurement) == ["sensor", "root_quat"]


def test_a_robot_that_is_fixed_to_the_world_has_its_attitude(folder, control, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    robot = folder / "robot.xml"
    text = robot.read_text().replace('<freejoint name="root"/>', "")
    text = text.replace('pos="0 0 0.4"', 'pos="0 0 0.4" quat="0.8 0.6 0 0"').replace(
        "0 0 0.4 1 0 0 0 ", ""
    )
    (tmp_path / "robot.xml").write_text(text)
    measurement = SimulatedRobot(tmp_path, control.estimated).read()
    assert measurement.root_quat == pytest.approx([0.8, 0.6, 0.0, 0.0])
    # It has no gyroscope: only a policy that reads one cannot be run.
    assert control.lacking(measurement) == ["root_ang_vel"]


def test_a_filter_is_that_of_first_order():
    low_pass = LowPass(0.3, 0.0)
    found = [float(low_pass(np.array(1.0))) for _ in range(5)]
    assert found == pytest.approx(1.0 - 0.7 ** np.arange(1, 6))


# -- from state to state -----------------------------------------------------------------------------------------


def test_states_follow_each_other_and_hand_over_smoothly(control):
    clock, robot, machine, lines = set_up(control)
    control.command["twist"] = np.array([2.0, 1.0])
    start = robot.pos.copy()
    punctuality = run(clock, robot, machine, lines, Unattended(0.6))
    assert [state for state, _ in itertools.groupby(lines.states)] == [
        State.DAMP,
        State.STAND,
        State.POLICY,
        State.STOP,
        State.DAMP,
    ]
    assert not machine.fault and punctuality.periods == len(robot.commands)
    assert robot.commands[0].stiffness.tolist() == [0.0, 0.0]
    assert robot.commands[0].damping.tolist() == [2.0, 2.0]
    places = [k for k, state in enumerate(lines.states) if state is State.STAND]
    standing = [robot.commands[k] for k in places]
    # It begins where the robot is, without stiffness, and ends in the default pose with the policy's gains.
    assert standing[0].pos == pytest.approx(start, abs=0.02)
    assert standing[0].stiffness == pytest.approx(0.0)
    assert standing[-1].pos == pytest.approx(DEFAULT, abs=0.02)
    assert standing[-1].stiffness == pytest.approx([30.0, 20.0], rel=0.02)
    # No target jumps: the largest step is at the steepest place of the curve from 0 to 1.7 rad in 0.4 s.
    pos = np.array([command.pos for command in robot.commands])
    asked = np.array([command.stiffness.min() > 1.0 for command in robot.commands])
    jumps = np.abs(np.diff(pos, axis=0)).max(axis=1)[asked[1:] & asked[:-1]]
    assert jumps.max() < 1.5 * 1.7 * PERIOD / 0.4 + 0.02
    assert robot.commands[-1].stiffness.tolist() == [0.0, 0.0]


def test_words_that_lead_nowhere_are_said_and_change_nothing(control):
    clock, robot, machine, lines = set_up(control)
    run(clock, robot, machine, lines, Script(policy=0.1, stand=0.2, dance=0.3, stop=0.4))
    early = Script(stand=0.1, policy=0.2, damp=0.3)
    assert lines.events[:3] == [
        "operator: 'policy' leads nowhere from damp",
        "damp -> stand: operator: stand",
        "operator: 'dance' leads nowhere from stand",
    ]
    clock, robot, machine, lines = set_up(control)
    run(clock, robot, machine, lines, early)
    assert lines.events[1] == "operator: 'policy' has to wait until the robot stands"
    assert lines.events[2] == "stand -> damp: operator: damp" and not machine.fault


def test_nothing_beyond_the_ranges_of_the_training_reaches_a_policy(folder, control):
    _, robot, machine, lines = set_up(control)
    assert sort_words(["9 0.5", "8 0.5", "0.5 0.5", "9 0.5"], machine, 0.0) == []
    # A stick that is held beyond the range says so once.
    assert lines.events == [
        "operator: twist 9 0.5: clipped to -1 -0.5 to 2 1",
        "operator: twist 0.5 0.5",
        "operator: twist 9 0.5: clipped to -1 -0.5 to 2 1",
    ]
    assert control.command["twist"].tolist() == [2.0, 0.5]
    measurement = robot.read()
    expected = control(measurement).pos
    # A command that is written past the operator's words asks for no more.
    control.begin()
    control.command["twist"][:] = (9.0, 0.5)
    assert control(measurement).pos == pytest.approx(expected)
    runner = Runner(folder)
    runner.step(runner.act(), {"twist": np.array([2.0, 0.5])})
    with pytest.raises(ValueError, match="'twist': 9 0.5: expected -1 -0.5 to 2 1"):
        runner.step(runner.act(), {"twist": np.array([9.0, 0.5])})
    with pytest.raises(ValueError, match="command 'speed': expected one of"):
        runner.step(runner.act(), {"speed": np.array([9.0, 0.5])})


def test_a_runner_begins_with_a_command_that_the_policy_has_seen(folder, tmp_path):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "export.json"
    path.write_text(path.read_text().replace('"low": [-1.0', '"low": [0.4'))
    assert Runner(tmp_path).command["twist"].tolist() == [0.4, 0.0]


def test_an_operator_changes_the_command(control):
    _, _, machine, lines = set_up(control)
    assert sort_words(["0.5 -0.25", "stop"], machine, 0.0) == ["stop"]
    assert control.command["twist"].tolist() == [0.5, -0.25]
    assert sort_words(["0.5", "nan 1"], machine, 0.0) == []
    assert lines.events[1:] == [
        "operator: '0.5': expected 2 numbers",
        "operator: 'nan 1': expected 2 numbers",
    ]


@pytest.fixture
def handlers():
    kept = {number: signal.getsignal(number) for number in (*STOPS, *OF_THE_TERMINAL)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


def test_what_would_end_or_halt_the_program_is_stop_and_then_damp(handlers):
    interrupts = Interrupts()
    interrupts.listen()
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"):
        number = signal.Signals[name]
        # Else the test itself would end here.
        assert signal.getsignal(number) not in (signal.SIG_DFL, signal.default_int_handler)
        signal.raise_signal(number)
    assert interrupts.words(0.0, None) == ["stop", *4 * ["damp"]]
    # Python would print to a terminal, or read of one, that another program has.
    assert signal.getsignal(signal.SIGTTIN) == signal.getsignal(signal.SIGTTOU) == signal.SIG_IGN


class Gone:
    """A terminal that says a word, and then is away."""

    def __iter__(self):
        yield "stand\n"
        raise OSError("Input/output error")


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (lambda: io.StringIO("stand\n\n"), ["stand", "stop"]),
        (lambda: io.TextIOWrapper(io.BytesIO(b"\xff\n"), encoding="utf-8"), ["stop"]),
        (Gone, ["stand"]),
        (lambda: None, []),
    ],
    ids=["ends", "no text", "is gone", "no input"],
)
def test_a_keyboard_that_is_heard_no_more_says_stop_where_it_leads(lines, said):
    for leads, expected in ((True, [*said, "stop"]), (False, said)):
        keyboard = Keyboard(lines(), leads=leads)
        keyboard.thread.join()
        assert keyboard.words(0.0, None) == expected


# -- time --------------------------------------------------------------------------------------------------------


def test_deadlines_stay_on_their_grid():
    assert next_deadline(1.0, 0.02, 1.005) == (1.02, 0)
    found, missed = next_deadline(1.0, 0.02, 1.07)
    assert found == pytest.approx(1.08) and missed == 3


def test_a_slow_period_moves_no_later_deadline(control):
    clock, robot, machine, lines = set_up(control)
    times = []

    def slow(measurement):
        times.append(clock.now())
        clock.time += 0.013
        return measurement

    robot.harm = slow
    run(clock, robot, machine, lines, Script(stop=0.3))
    assert times == pytest.approx(PERIOD * np.arange(len(times)))


def test_quantiles_of_durations_are_those_of_numpy():
    seconds = np.random.default_rng(1).gamma(2.0, 1e-3, 5000)
    durations = Durations()
    for value in seconds:
        durations.add(value)
    for share in (0.5, 0.99):
        assert durations.quantile(share) == pytest.approx(np.quantile(seconds, share), abs=3e-5)
    assert durations.count_beyond(3e-3) == pytest.approx((seconds > 3e-3).sum(), abs=30)
    assert durations.longest == seconds.max() and math.isnan(Durations().quantile(0.5))


# -- the program -------------------------------------------------------------------------------------------------


def test_the_file_runs_by_itself_in_real_time(folder, tmp_path):
    for name in ("torch", "ksim_rl", "warp", "tensordict"):
        (tmp_path / f"{name}.py").write_text(f"raise ImportError('{name} is not here')\n")
    quick = (
        "--dry-seconds",
        "0.1",
        "--stand-seconds",
        "0.1",
        "--damp-seconds",
        "0.1",
        "--stop-seconds",
        "0.1",
        "--most-tilt",
        "4",
    )
    program = [sys.executable, "loop.py", "--simulate", "--seconds", "0.2", "--command", "0", "0"]
    files = ["--log", str(tmp_path / "log.csv"), "--report", str(tmp_path / "report.json")]
    done = subprocess.run(
        [*program, *quick, *files, "--most-speed", "1000", "--position-margin", "9"],
        cwd=folder,
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert "dry -> damp: the dry run is over" in done.stdout
    assert report["periods"] >= 70 and not report["fault"] and report["period_ms"] == 20.0
    assert "stop -> damp: stopped" in done.stdout
