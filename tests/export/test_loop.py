"""The loop of an exported folder: it acts as `runner.py` does, and ends in damped motors whatever happens."""

import ast
import dataclasses
import io
import itertools
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading

import mujoco
import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.folder import LOOP_PARTS, PARTS, STANDALONE
from ksim_rl.export.standalone.deadlines import Durations, next_deadline
from ksim_rl.export.standalone.files import read_json
from ksim_rl.export.standalone.journal import MOST_WAITING, Journal
from ksim_rl.export.standalone.loop import run_loop
from ksim_rl.export.standalone.loop_command import drive, loop_parser
from ksim_rl.export.standalone.plan_control import PlanControl
from ksim_rl.export.standalone.policy_control import PolicyControl
from ksim_rl.export.standalone.robot_link import DescribedJoints, JointCommand, Measurement
from ksim_rl.export.standalone.runner import Runner
from ksim_rl.export.standalone.safety import EffortLimit, Limits, tilt_of, unguarded
from ksim_rl.export.standalone.simulated_robot import SimulatedRobot
from ksim_rl.export.standalone.stages import LowPass
from ksim_rl.export.standalone.states import State, StateMachine, Times
from ksim_rl.export.standalone.words import (
    OF_THE_TERMINAL,
    STOPS,
    EndOfPlan,
    Interrupts,
    Keyboard,
    Unattended,
    sort_words,
)
from ksim_rl.identification.excitation import propose
from ksim_rl.identification.fit import fit
from ksim_rl.identification.held_robot import hold
from ksim_rl.identification.joint_log import read_log
from tests.export.toy_folder import DEFAULT, MODEL, toy_folder

PERIOD = 0.02
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
TIMES = Times(stand_seconds=0.4, blend_seconds=0.2, stop_seconds=0.2, damp_seconds=0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return toy_folder(tmp_path_factory.mktemp("toy"))


@pytest.fixture
def control(folder):
    return PolicyControl(folder, read_json(folder / "export.json"))


class Clock:
    """Time that passes only where somebody waits."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep_until(self, deadline):
        self.time = max(self.time, deadline)


class Bench:
    """A robot on a bench: joints go where they are asked to, and nothing falls. `harm` spoils what it reads."""

    def __init__(self, clock):
        self.clock = clock
        self.pos = np.array([0.9, -1.4])
        self.vel = np.zeros(2)
        self.commands = []
        self.harm = lambda measurement: measurement
        self.write_fails = False

    def read(self):
        return self.harm(
            Measurement(
                stamp=self.clock.now(),
                joint_pos=self.pos.copy(),
                joint_vel=self.vel.copy(),
                joint_effort=np.zeros(2),
                root_quat=UPRIGHT,
                root_ang_vel=np.zeros(3),
                estimates={"sensor": np.zeros(3)},
            )
        )

    def write(self, command):
        if self.write_fails:
            raise OSError("the cable is out")
        self.commands.append(command)
        # As in honey: the speed follows the pull.
        self.vel = command.stiffness * (command.pos - self.pos) / 3.0
        self.pos = self.pos + PERIOD * self.vel

    def close(self):
        pass


class Lines:
    """A log in memory."""

    def __init__(self):
        self.events = []
        self.states = []

    def period(self, now, state, measurement, command):
        self.states.append(state)

    def event(self, now, text):
        self.events.append(text)


class Script:
    """Says words at times."""

    def __init__(self, **at):
        self.left = sorted((time, word) for word, time in at.items())

    def words(self, now, machine):
        found = [word for time, word in self.left if time <= now + 1e-9]
        self.left = self.left[len(found) :]
        return found


def set_up(control, *, limits=None, times=TIMES):
    clock = Clock()
    lines = Lines()
    machine = StateMachine(
        control, period=PERIOD, limits=limits or Limits(), times=times, note=lines.event
    )
    robot = Bench(clock)
    robot.lines = lines
    return clock, robot, machine, lines


def run(clock, robot, machine, lines, *operators):
    return run_loop(robot, machine, operators, lines, clock=clock, period=PERIOD)


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
    # No target jumps: the largest step is that of 1.7 rad in 0.4 s, at the steepest place of the curve.
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


# -- faults ------------------------------------------------------------------------------------------------------


def changed(**fields):
    """Return what gives a robot's measurements other fields."""
    return lambda measurement: dataclasses.replace(measurement, **fields)


def turned(degrees):
    half = math.radians(degrees) / 2.0
    return np.array([math.cos(half), math.sin(half), 0.0, 0.0])


def too_late(robot, machine):
    robot.harm = changed(stamp=robot.clock.now() - 0.005)


def another_clock(robot, machine):
    robot.harm = changed(stamp=robot.clock.now() + 1.0)


def lost(robot, machine):
    robot.harm = lambda measurement: None


def read_fails(robot, machine):
    def fail(measurement):
        raise ConnectionError("no route")

    robot.harm = fail


def write_fails(robot, machine):
    robot.write_fails = True


def exits(robot, machine):
    def leave(measurement):
        sys.exit("a robot's own code")

    robot.harm = leave


def operator_fails(robot, machine):
    raise RuntimeError("no remote")


def log_fails(robot, machine):
    log = robot.lines.period

    def fail(now, state, measurement, command):
        log(now, state, measurement, command)
        raise RuntimeError("other columns")

    robot.lines.period = fail


def loop_waits(robot, machine):
    # The system ran something else for as long.
    sleep_until = robot.clock.sleep_until

    def late(deadline):
        robot.clock.sleep_until = sleep_until
        sleep_until(deadline + 0.2)

    robot.clock.sleep_until = late


def period_is_long(robot, machine):
    observe = machine.control.observe.run

    def wait(given):
        robot.clock.time += 0.2
        return observe(given)

    machine.control.observe.run = wait


def policy_raises(robot, machine):
    def fail(measurement):
        raise RuntimeError("no such\nnode")

    machine.control.observe.run = fail


def policy_gives_nan(robot, machine):
    machine.control.policy = lambda frame: np.array([0.0, np.nan])


def reads(**fields):
    def harm(robot, machine):
        robot.harm = changed(**fields)

    return harm


FAULTS = {
    "late": (too_late, "no message from the robot for 0.065 s: expected one in 0.060 s"),
    "lost": (lost, "no message from the robot"),
    "nan": (reads(joint_pos=np.array([0.0, np.nan])), "joint_pos of left is nan"),
    "infinite speed": (reads(joint_vel=np.array([-np.inf, 0.0])), "joint_vel of right is -inf"),
    "short": (reads(joint_pos=np.zeros(3)), "joint_pos has the shape (3,): expected (2,)"),
    "nan of the gyroscope": (
        reads(root_ang_vel=np.full(3, np.nan)),
        "root_ang_vel is [nan, nan, nan]",
    ),
    "no attitude": (reads(root_quat=np.zeros(4)), "root_quat has the length 0.000: expected 1"),
    "nan of an estimate": (
        reads(estimates={"sensor": np.full(3, np.nan)}),
        "sensor is [nan, nan, nan]",
    ),
    "out of range": (
        reads(joint_pos=np.array([0.0, -2.1])),
        "left is at -2.100: expected -2.000 to inf",
    ),
    "too fast": (
        reads(joint_vel=np.array([0.0, 21.0])),
        "left moves with 21.0 per s: expected at most 20.0",
    ),
    "tilted": (reads(root_quat=turned(75)), "tilted by 75 degrees: expected at most 57"),
    "short attitude": (
        reads(root_quat=UPRIGHT[:3]),
        "root_quat has the shape (3,): expected (4,)",
    ),
    "another clock": (
        another_clock,
        "a message's stamp is 0.980 s ahead of the loop: expected s of time.monotonic",
    ),
    "no stamp": (
        reads(stamp=math.nan),
        "a message's stamp is nan s ahead of the loop: expected s of time.monotonic",
    ),
    "exits": (exits, "read: SystemExit: a robot's own code"),
    "operator fails": (operator_fails, "operator: RuntimeError: no remote"),
    "log fails": (log_fails, "log: RuntimeError: other columns"),
    "read fails": (read_fails, "read: ConnectionError: no route"),
    "write fails": (write_fails, "write: OSError: the cable is out"),
    "loop waits": (loop_waits, "the loop ran 0.200 s late: is the computer busy?"),
}
OF_THE_POLICY = {
    "policy raises": (policy_raises, "RuntimeError: no such node"),
    "period is long": (period_is_long, "a period took 0.200 s: is the computer busy?"),
    "policy gives nan": (policy_gives_nan, "the policy's target of left (pos) is not finite"),
}


@pytest.mark.parametrize(
    ("name", "time"),
    [(name, time) for name in FAULTS for time in (0.3, 0.7)]
    + [(name, 0.7) for name in OF_THE_POLICY],
)
def test_every_fault_ends_in_damped_motors_with_one_line(control, name, time):
    harm, line = {**FAULTS, **OF_THE_POLICY}[name]
    clock, robot, machine, lines = set_up(control)
    state = State.STAND if time < 0.5 else State.POLICY

    class Harm:
        done = False

        def words(self, now, machine):
            if now + 1e-9 >= time and not self.done:
                self.done = True
                # Else the test would not see what it is about.
                assert machine.state is state
                harm(robot, machine)
            return []

    run(clock, robot, machine, lines, Script(stand=0.1, policy=0.52, stop=1.5), Harm())
    (fault,) = [event for event in lines.events if "fault" in event]
    assert fault == f"{state.name.lower()} -> damp: fault: {line}"
    # From the fault on, which came after the state, all that was sent is to brake.
    damped = lines.states[lines.states.index(state) :].count(State.DAMP)
    assert damped >= TIMES.damp_seconds / PERIOD
    for command in robot.commands[-damped:] if name != "write fails" else ():
        assert command.stiffness.tolist() == [0.0, 0.0] and command.effort.tolist() == [0.0, 0.0]
        assert command.damping.tolist() == [2.0, 2.0] and np.isfinite(command.pos).all()
    # The operator's stop of later comes too late to be obeyed.
    assert clock.now() < 1.5


def test_a_message_that_is_late_once_is_no_fault(control):
    clock, robot, machine, lines = set_up(control)
    stamp = clock.now() - 2.5 * PERIOD
    robot.harm = changed(stamp=stamp)
    assert machine.tick(0.0, robot.read(), []).damping.tolist() == [2.0, 2.0]
    assert not machine.fault


# -- efforts -----------------------------------------------------------------------------------------------------


def test_targets_are_moved_so_far_that_efforts_stay_in_their_limits(control):
    limit = EffortLimit(control.joints, 0.5)
    draws = np.random.default_rng(2)
    # So fast that some brakes alone would be too strong.
    measured = dataclasses.replace(Bench(Clock()).read(), joint_vel=np.array([7.0, -8.0]))
    moved = np.zeros(2, int)
    for _ in range(200):
        pos, vel, effort = draws.normal(0.0, 1.0, (3, 2))
        stiffness = control.joints.stiffness * draws.integers(0, 2, 2)
        command = JointCommand(
            pos=pos, vel=vel, effort=9.0 * effort, stiffness=stiffness, damping=np.ones(2)
        )

        def exerted(command):
            away = command.stiffness * (command.pos - measured.joint_pos)
            return command.effort + away + command.damping * (command.vel - measured.joint_vel)

        found = limit(command, measured)
        assert exerted(found) == pytest.approx(np.clip(exerted(command), -9.0, 9.0))
        # Nothing new pushes: neither a target behind the measured position, nor an effort.
        way = (found.pos - measured.joint_pos) / (command.pos - measured.joint_pos)
        assert (way >= -1e-9).all() and (way <= 1.0 + 1e-9).all()
        assert (np.abs(found.effort) <= np.abs(command.effort)).all()
        moved += np.abs(exerted(command)) > 9.0
    assert limit.clipped() == {"right": moved[0], "left": moved[1]} and min(moved) > 20


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Limits(effort_share=1.5), "--effort-share 1.5: expected 0.01 to 1"),
        # Times a limit of inf it would be NaN.
        (lambda: Limits(effort_share=0.0), "--effort-share 0: expected 0.01 to 1"),
        (lambda: Limits(late_periods=0.5), "--late-periods 0.5: expected 1 to inf"),
        (lambda: Limits(most_tilt=math.nan), "--most-tilt nan: expected 0 to inf"),
        (lambda: Times(stop_seconds=-1.0), "--stop-seconds -1: expected 0 or more"),
        (lambda: Times(stand_seconds=0.0), "--stand-seconds 0: expected 0.1 or more"),
        (lambda: Times(damping_factor=0.0), "--damping-factor 0: expected 0.1 or more"),
    ],
)
def test_wrong_options_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--simulate"], "--simulate and --hang are of the simulated robot"),
        (["--seconds", "nan"], "--seconds nan: expected 0 or more"),
        (["--command", "0", "nan"], "--command 0.0 nan: expected finite numbers"),
        (["--plan", "p.csv", "--command", "0"], "--command: a plan follows none"),
        (["--plan", "p.csv", "--seconds", "3"], "--seconds: a plan says itself"),
    ],
)
def test_a_robot_is_not_driven_with_options_that_do_not_fit(control, arguments, said):
    robot = Bench(Clock())
    # It cannot even be read: all of it is refused before.
    robot.harm = None
    with pytest.raises(ValueError, match=said):
        drive(robot, control, loop_parser().parse_args(arguments))


@pytest.mark.parametrize(("value", "said"), [(None, "nan"), (-1.0, "-1"), (math.inf, "inf")])
def test_gains_that_no_motor_may_be_given_are_refused(control, value, said):
    joints = {**control.meta["joints"], "damping": [1.0, value]}
    with pytest.raises(ValueError, match=f"joints.damping of 'left' is {said}: expected 0 to inf"):
        DescribedJoints({**control.meta, "joints": joints})


def test_what_nothing_limits_holds_or_brakes_is_named(control):
    measurement = Bench(Clock()).read()
    assert unguarded(control.joints, measurement) == []
    control.joints.most_effort[0] = math.inf
    control.joints.stiffness[1] = 0.0
    control.joints.damping[:] = 0.0
    assert unguarded(control.joints, dataclasses.replace(measurement, root_quat=None)) == [
        "no limit of effort: right",
        "no stiffness, so that nothing holds them in stand: left",
        "no damping, so that nothing brakes them: right, left",
        "no attitude: the tilt is not watched",
    ]


# -- the log -----------------------------------------------------------------------------------------------------


def test_identify_reads_the_log(control, tmp_path):
    path = tmp_path / "leg.xml"
    path.write_text(MODEL)
    robot = hold(str(path))
    clock, bench, machine, _ = set_up(control)
    shown = []
    journal = Journal(tmp_path / "a.csv", control.joints, shown.append)
    machine.note = journal.event
    run_loop(bench, machine, [Unattended(4.0)], journal, clock=clock, period=PERIOD)
    journal.close()
    assert not machine.fault
    log = read_log(tmp_path / "a.csv", robot)
    places = [control.joints.names.index(name) for name in robot.joint_names]
    sent = np.array([command.pos for command in bench.commands])[:, places]
    assert log.targets.by_kind["pos"] == pytest.approx(sent, rel=1e-6)
    assert log.time_T == pytest.approx(PERIOD * np.arange(len(sent)), abs=1e-5)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    first = dict(zip(lines[0].split(","), lines[-1].split(","), strict=True))
    assert float(first["projected_gravity.z"]) == -1.0 and float(first["root_ang_vel.x"]) == 0.0
    events = [line for line in lines if line.startswith("#")]
    assert [line.removeprefix("# ") for line in events] == shown and len(events) == 4
    with pytest.raises(FileExistsError):
        Journal(tmp_path / "a.csv", control.joints, print)


def test_a_disk_that_stands_still_delays_nothing_and_what_is_lost_is_counted(control, tmp_path):
    goes_on = threading.Event()

    def wait(text):
        goes_on.wait()

    journal = Journal(tmp_path / "a.csv", control.joints, wait)
    journal.event(0.0, "the terminal stands still")
    measurement = Bench(Clock()).read()
    names = [field.name for field in dataclasses.fields(JointCommand)]
    command = JointCommand(**dict.fromkeys(names, np.zeros(2)))
    for k in range(MOST_WAITING + 50):
        journal.period(0.02 * k, State.DAMP, measurement, command)
    assert 50 <= journal.lost <= 51
    goes_on.set()
    journal.close()
    written = (tmp_path / "a.csv").read_text().splitlines()
    assert len(written) == 2 + MOST_WAITING + 50 - journal.lost


def test_a_plan_is_followed_and_its_log_holds_nothing_else(folder, control, tmp_path):
    time_T = 0.01 * np.arange(600)
    plan = tmp_path / "plan.csv"
    sines = 0.3 * np.sin(np.outer(time_T, (3.0, 4.0))) + (0.2, -0.1)
    names = ["time", "right.target_position", "left.target_position"]
    np.savetxt(plan, np.c_[time_T, sines], "%.9g", ",", header=",".join(names), comments="")
    robot, follows, machine = follow(folder, control, tmp_path)
    assert follows.period == pytest.approx(0.01)
    assert not machine.fault and robot.data.qpos[:3] == pytest.approx([0.0, 0.0, 0.9], abs=1e-3)
    (tmp_path / "leg.xml").write_text(MODEL)
    leg = hold(str(tmp_path / "leg.xml"))
    log = read_log(tmp_path / "a.csv", leg)
    order = [follows.joints.names.index(name) for name in leg.joint_names]
    assert log.targets.by_kind["pos"][:600] == pytest.approx(sines[:, order], rel=1e-6)
    assert len(log.time_T) in (600, 601) and log.time_T[599] == pytest.approx(5.99, abs=1e-4)


def test_a_robot_that_hangs_moves_as_one_whose_base_is_fixed(folder):
    robot = SimulatedRobot(folder, ())
    robot.change_period(0.005)
    robot.hang(np.full(2, np.inf), lift=0.5)
    loose = re.sub(r"<freejoint[^>]*>|<keyframe>.*</keyframe>", "", MODEL)
    fixed = mujoco.MjModel.from_xml_string(loose)
    fixed.actuator_biasprm[:] = 0.0
    data = mujoco.MjData(fixed)
    data.qpos[:] = robot.data.qpos[7:]
    still = dict.fromkeys([field.name for field in dataclasses.fields(JointCommand)], np.zeros(2))
    for _ in range(40):
        robot.write(JointCommand(**still))
        mujoco.mj_step(fixed, data)
    assert robot.data.qpos[7:] == pytest.approx(data.qpos, abs=1e-5)
    assert np.abs(data.qvel).min() > 0.3


@pytest.mark.full
def test_identify_finds_a_robots_numbers_in_the_log_of_a_plan(folder, control, tmp_path):
    (tmp_path / "leg.xml").write_text(MODEL)
    leg = hold(str(tmp_path / "leg.xml"))
    proposed = propose(leg, ["pos"], seconds=8.0)
    names = ["time", *(f"{name}.target_position" for name in leg.joint_names)]
    table = np.c_[proposed.time_T, proposed.by_kind["pos"]]
    np.savetxt(tmp_path / "plan.csv", table, "%.9g", ",", header=",".join(names), comments="")
    follow(folder, control, tmp_path)
    found = fit(leg, read_log(tmp_path / "a.csv", leg), note=lambda text: None)
    for name, stiffness in (("left", 20.0), ("right", 30.0)):
        numbers = found.joints[name]
        assert numbers["armature"].value == pytest.approx(0.02, rel=0.05)
        assert numbers["stiffness"].value == pytest.approx(stiffness, rel=0.05)
    assert found.delay_s.value < 1e-3 and not found.warnings


def follow(folder, control, files):
    """Let a simulated robot follow `plan.csv`, log it as `a.csv`, and return robot, plan and state machine."""
    plan = PlanControl(control.meta, files / "plan.csv")
    robot = SimulatedRobot(folder, ())
    robot.change_period(plan.period)
    robot.hang(np.full(2, np.inf), lift=0.5)
    clock, _, _, lines = set_up(control)
    robot.read = stamped(robot.read, clock)
    times = dataclasses.replace(TIMES, blend_seconds=0.0)
    machine = StateMachine(plan, period=PERIOD, limits=Limits(), times=times, note=lines.event)
    journal = Journal(files / "a.csv", plan.joints, lambda text: None, only=State.POLICY)
    operators = [Unattended(math.inf), EndOfPlan(plan)]
    run_loop(robot, machine, operators, journal, clock=clock, period=plan.period)
    journal.close()
    return robot, plan, machine


def stamped(read, clock):
    """Return what reads a robot, whose messages are of a clock."""
    return lambda: dataclasses.replace(read(), stamp=clock.now())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,right.target_position\n0,1\n1,1\n", "no column left.target_position, though"),
        ("time,x\n0,1\n1,1\n3,1\n", "'time': expected at least two lines at an even rate"),
        ("time,x\n0,1\n1,nan\n", "expected 2 finite numbers in each line"),
        ("time,x\n0,a\n", "no table of numbers"),
    ],
)
def test_a_plan_that_cannot_be_followed_is_refused(control, tmp_path, text, said):
    (tmp_path / "plan.csv").write_text(text)
    with pytest.raises(ValueError, match=said):
        PlanControl(control.meta, tmp_path / "plan.csv")


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
    assert report["periods"] >= 70 and not report["fault"] and report["period_ms"] == 20.0
    assert "stop -> damp: stopped" in done.stdout
