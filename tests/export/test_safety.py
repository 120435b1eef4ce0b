"""Whatever goes wrong, the loop of an exported folder ends in damped motors, and keeps limits until then."""

import dataclasses
import math
import shutil
import sys

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.standalone import loop_command
from ksim_rl.export.standalone.command import main as run_episodes
from ksim_rl.export.standalone.loop_command import drive, loop_parser
from ksim_rl.export.standalone.robot_link import DescribedJoints, JointCommand
from ksim_rl.export.standalone.safety import EffortLimit, Limits, unguarded
from ksim_rl.export.standalone.states import State, Times
from tests.export.loop_bench import (
    PERIOD,
    TIMES,
    UPRIGHT,
    Bench,
    Clock,
    Script,
    run,
    set_up,
)

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

    def fail(now, state, measurement, command, asked):
        log(now, state, measurement, command, asked)
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


def policy_exits(robot, machine):
    machine.control.observe.run = lambda given: sys.exit("no license")


def policy_gives_nan(robot, machine):
    machine.control.policy = lambda frame, pictures: np.array([0.0, np.nan])


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
    "attitude lost": (
        reads(root_quat=None),
        "no root_quat in a message: the ones before had it",
    ),
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
    "policy exits": (policy_exits, "SystemExit: no license"),
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


def test_readings_whose_efforts_have_no_sum_are_a_fault(control):
    _, robot, machine, _ = set_up(control)
    robot.pos = np.array([-1e308, 0.0])
    robot.vel = np.array([1.7e308, 0.0])
    machine.state = State.STOP
    machine.first_share = 0.5
    with np.errstate(all="ignore"):
        command = machine.tick(0.0, robot.read(), [])
    assert machine.fault == "the policy's target of right (effort) is not finite"
    assert command.stiffness.tolist() == [0.0, 0.0] and command.damping.tolist() == [2.0, 2.0]


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
        (lambda: Times(dry_seconds=0.0), "--dry-seconds 0: expected 0.1 or more"),
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
        (["--command", "9", "0"], "command 'twist': 9 0: expected -1 -0.5 to 2 1"),
        (["--plan", "p.csv", "--command", "0"], "--command: a plan follows none"),
        (["--plan", "p.csv", "--seconds", "3"], "--seconds: a plan says itself"),
        (["--plan", "p.csv", "--dry-run"], "--dry-run: a plan has no policy"),
        (["--dry-run", "--seconds", "3"], "--seconds: a dry run has --dry-seconds"),
        (["--report", "nowhere/a.json"], "--report nowhere/a.json: there is no folder nowhere"),
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


@pytest.mark.parametrize(
    ("what", "value", "said"),
    [
        ("effort", [18.0, -1.0], "effort of 'left' is -1: expected 0 or more"),
        ("velocity", [-2.0, None], "velocity of 'right' is -2: expected 0 or more"),
        ("position", [[1.0, 0.5], [None, 1.0]], "position of 'right' is 0.5: expected 1 or more"),
        ("effort", [18.0], "effort: expected an entry for each of 2 joints"),
        ("velocity", 3.0, "velocity: expected an entry for each of 2 joints"),
    ],
)
def test_limits_that_would_drive_a_joint_are_refused(control, what, value, said):
    limits = {**control.meta["joints"]["limits"], what: value}
    joints = {**control.meta["joints"], "limits": limits}
    with pytest.raises(ValueError, match=f"export.json: joints.limits.{said}"):
        DescribedJoints({**control.meta, "joints": joints})


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"effort": [18.0', '"effort": [NaN', "NaN: expected finite numbers"),
        ('"effort": [18.0', '"effort": [1e999', "1e999: expected finite numbers"),
        (
            '"step_dt": 0.02',
            '"step_dt": 0.0',
            "step_dt is 0.0: expected more than 0 and at most 10",
        ),
        ('"step_dt": 0.02', '"step_dt": "fast"', "step_dt is fast: expected more than 0"),
        ('"num_actions": 2', '"num_actions": 1e12', "policy.num_actions is 1000000000000.0: exp"),
        ('"joints"', '"limbs"', "KeyError: 'joints'"),
        ('"size": 2', '"size": []', "sequence"),
        # What only the simulated robot reads.
        ('"decimation"', '"substeps"', "KeyError: 'decimation'"),
    ],
)
def test_a_strange_folder_is_refused_in_one_line(
    folder, tmp_path, monkeypatch, capsys, old, new, said
):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "export.json"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["loop.py", str(tmp_path), "--simulate", "--seconds", "1"])
    with pytest.raises(SystemExit) as ended:
        loop_command.main()
    found = capsys.readouterr().err
    assert ended.value.code == 2 and found.startswith("loop.py: error: ") and said in found
    assert str(tmp_path) in found and found.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--episodes", "0", "--episodes 0: expected at least 1"),
        ("--refine", "0", "--refine 0: expected at least 1"),
        ("--seed", "-1", "--seed -1: expected at least 0"),
        ("--output", "nowhere/a.json", "--output nowhere/a.json: there is no folder nowhere"),
    ],
)
def test_a_runner_refuses_its_options_before_it_runs(
    folder, monkeypatch, capsys, option, value, said
):
    monkeypatch.setattr(sys, "argv", ["runner.py", str(folder), option, value])
    with pytest.raises(SystemExit) as ended:
        run_episodes()
    assert ended.value.code == 2
    assert capsys.readouterr().err == f"runner.py: error: {said}\n"


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
    unseen = dataclasses.replace(measurement, root_ang_vel=None)
    assert "no gyroscope and no count" in unguarded(control.joints, unseen)[-1]
