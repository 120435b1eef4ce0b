"""Before a policy may move a robot it runs dry: what it would ask for is shown, checked, and sent nowhere."""

import csv
import dataclasses
import gc
import signal
import sys
import time

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.standalone.files import read_json
from ksim_rl.export.standalone.loop_command import drive, loop_parser
from ksim_rl.export.standalone.policy_control import PolicyControl
from ksim_rl.export.standalone.states import State
from ksim_rl.export.standalone.words import OF_THE_TERMINAL, STOPS, EndOfDryRun, Unattended
from tests.export.loop_bench import PERIOD, Bench, Clock, Script, run, set_up

DRY_S = 0.2
NUM_STEPS = 10


def test_the_policy_runs_dry_before_it_stands_and_before_it_moves(folder, control):
    clock, robot, machine, lines = set_up(control, dry_seconds=DRY_S)
    control.command["twist"] = np.array([1.0, -0.5])
    measured = []

    def keep(measurement):
        measured.append(measurement)
        return measurement

    robot.harm = keep
    run(clock, robot, machine, lines, Unattended(0.3))
    assert not machine.fault
    at = {state: [k for k, one in enumerate(lines.states) if one is state] for state in State}
    dry = [k for k, asked in enumerate(lines.asked) if asked is not None]
    # The state of a period is reported after it: the last dry one has led on.
    assert dry[:NUM_STEPS] == list(range(NUM_STEPS)) and at[State.DRY] == dry[: NUM_STEPS - 1]
    assert dry[NUM_STEPS:] == at[State.STAND][-NUM_STEPS:]
    # All that was sent meanwhile is to brake, and to hold the default pose.
    for k in dry[:NUM_STEPS]:
        assert robot.commands[k].stiffness.tolist() == [0.0, 0.0]
        assert robot.commands[k].effort.tolist() == [0.0, 0.0]
    for k in dry[NUM_STEPS:]:
        assert robot.commands[k].pos == pytest.approx(control.joints.default_pos)
    # The report shows this policy's actions for these measurements; before it moves the robot, the policy is reset.
    other = PolicyControl(folder, read_json(folder / "export.json"))
    other.command["twist"] = np.array([1.0, -0.5])
    for places in (dry[:NUM_STEPS], dry[NUM_STEPS:], at[State.POLICY]):
        other.begin()
        for k in places:
            expected = other(measured[k]).pos
            if lines.asked[k] is not None:
                assert lines.asked[k].pos == pytest.approx(expected)
    assert robot.commands[at[State.POLICY][-1]].pos == pytest.approx(expected)


def test_words_wait_for_the_dry_runs(control):
    clock, robot, machine, lines = set_up(control, dry_seconds=DRY_S)
    words = Script(stand=0.1, policy=0.15)
    # The robot stands 0.4 s later, and has run dry 0.2 s after that.
    later = [Script(stand=0.3), Script(policy=0.8), Script(policy=0.95), Script(stop=1.1)]
    run(clock, robot, machine, lines, words, *later)
    assert [line for line in lines.events if not line.startswith("dry run")] == [
        "operator: 'stand' has to wait until the dry run is over",
        "operator: 'policy' leads nowhere from dry",
        "dry -> damp: the dry run is over",
        "damp -> stand: operator: stand",
        "operator: 'policy' has to wait until the dry run is over",
        "stand -> policy: operator: policy",
        "policy -> stop: operator: stop",
        "stop -> damp: stopped",
    ]


def gives(action):
    def harm(machine, clock):
        machine.control.policy.run = lambda given: np.array(action)

    return harm


def takes(seconds):
    def harm(machine, clock):
        run_policy = machine.control.policy.run

        def slow(given):
            clock.time += seconds
            return run_policy(given)

        machine.control.policy.run = slow

    return harm


HARMS = {
    "nan": (gives([0.0, np.nan]), "dry", "the policy's target of left (pos) is not finite"),
    "slow": (
        takes(0.0165),
        "dry",
        "dry run: 1 % of the policy's steps took 16.5 ms or more: expected at most 16.0 ms of a period of 20 ms",
    ),
    "beyond": (gives([-3.0, 0.0]), "stand", "dry run: the policy would ask right for -0."),
}


@pytest.mark.parametrize("name", HARMS)
def test_a_policy_that_nothing_should_obey_never_moves_the_robot(control, name):
    harm, state, line = HARMS[name]
    # The default pose, -0.2, is within it, and what the policy asks for, -0.8, is not.
    control.joints.lowest[0] = -0.3
    clock, robot, machine, lines = set_up(control, dry_seconds=DRY_S)
    harm(machine, clock)
    run(clock, robot, machine, lines, Unattended(0.3))
    assert machine.fault.startswith(line) and State.POLICY not in lines.states
    assert lines.events[-1] == f"{state} -> damp: fault: {machine.fault}"
    # From any pose but standing it is only reported.
    if name == "beyond":
        told = [event for event in lines.events if "would be asked for" in event]
        assert [event.endswith(": beyond its limits") for event in told] == 2 * [True, False]


@pytest.fixture
def kept_process():
    """Keep what a loop changes of its process: signals, the garbage collector, turns of threads."""
    kept = {number: signal.getsignal(number) for number in (*STOPS, *OF_THE_TERMINAL)}
    interval = sys.getswitchinterval()
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)
    sys.setswitchinterval(interval)
    gc.unfreeze()
    gc.enable()


class RealTime(Clock):
    """The computer's time."""

    def now(self):
        return time.monotonic()


@pytest.mark.parametrize("fails", [False, True])
def test_a_dry_run_alone_sends_nothing_and_says_by_its_code_whether_it_passed(
    control, kept_process, tmp_path, fails
):
    robot = Bench(RealTime())
    if fails:
        control.policy.run = lambda given: np.array([np.nan, 0.0])
    log = tmp_path / "log.csv"
    words = ["--dry-run", "--dry-seconds", "0.1", "--damp-seconds", "0.1", "--late-periods", "50"]
    options = loop_parser().parse_args([*words, "--log", str(log), "--no-real-time"])
    assert drive(robot, control, options) == int(fails)
    assert robot.commands == []
    text = log.read_text()
    assert ("is not finite" in text) == fails
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    asked = [row for row in rows if row["left.dry_position"] != "nan"]
    assert len(asked) == (0 if fails else 5)
    # What motors would have been sent is beside it: to brake.
    assert {row["left.stiffness"] for row in rows} == {"0"}


def test_a_dry_run_that_was_stopped_is_none(control, kept_process, tmp_path):
    class Stop:
        def words(self, now, machine):
            return ["stop"]

    log = tmp_path / "log.csv"
    words = ["--dry-run", "--damp-seconds", "0.1", "--late-periods", "50", "--log", str(log)]
    options = loop_parser().parse_args(words)
    assert drive(Bench(RealTime()), control, options, operators=[Stop()]) == 1


def test_the_end_is_said_once(control):
    clock, robot, machine, lines = set_up(control, dry_seconds=DRY_S)
    run(clock, robot, machine, lines, EndOfDryRun())
    assert lines.events[-2:] == ["dry -> damp: the dry run is over", "damp -> damp: operator: stop"]
    assert {command.stiffness.max() for command in robot.commands} == {0.0}


# -- a firmware that repeats one state ---------------------------------------------------------------------------


def repeated(**fields):
    """Return a harm by which a robot's first state comes again and again, at the present time."""
    kept = []

    def repeat(measurement):
        kept.append(measurement)
        return dataclasses.replace(kept[0], stamp=measurement.stamp, **fields)

    return repeat


@pytest.mark.parametrize(
    ("fields", "fault"),
    [
        ({}, "the robot has measured the same for 0.5"),
        ({"count": 7}, "the robot sends one state again and again: its count is 7 for 0.080 s"),
        # Encoders of an arm at rest read the same for hours.
        ({"root_quat": None, "root_ang_vel": None}, ""),
    ],
)
def test_a_state_that_is_sent_again_and_again_is_a_fault(control, fields, fault):
    clock, robot, machine, lines = set_up(control)
    robot.harm = repeated(**fields)
    run(clock, robot, machine, lines, Script(stop=1.0))
    assert machine.fault.startswith(fault) and bool(machine.fault) == bool(fault)


def test_a_count_that_moves_is_no_fault(control):
    clock, robot, machine, lines = set_up(control)
    # A robot that sends at half the rate of the loop.
    robot.harm = lambda measurement: dataclasses.replace(
        measurement, count=int(clock.now() / PERIOD + 0.5) // 2
    )
    run(clock, robot, machine, lines, Script(stop=1.0))
    assert not machine.fault
