"""The log of the loop of an exported folder is what `ksim-rl identify` reads, of a plan of its commands, too."""

import dataclasses
import math
import re
import threading

import mujoco
import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="needs the extra: pip install ksim_rl[export]")
pytest.importorskip("onnx", reason="needs the extra: pip install ksim_rl[export]")

from ksim_rl.export.standalone.journal import MOST_WAITING, Journal
from ksim_rl.export.standalone.loop import run_loop
from ksim_rl.export.standalone.plan_control import PlanControl
from ksim_rl.export.standalone.robot_link import JointCommand
from ksim_rl.export.standalone.safety import Limits
from ksim_rl.export.standalone.simulated_robot import SimulatedRobot
from ksim_rl.export.standalone.states import State, StateMachine
from ksim_rl.export.standalone.words import (
    EndOfPlan,
    Unattended,
)
from ksim_rl.identification.excitation import propose
from ksim_rl.identification.fit import fit
from ksim_rl.identification.held_robot import hold
from ksim_rl.identification.joint_log import read_log
from tests.export.loop_bench import (
    PERIOD,
    TIMES,
    Bench,
    Clock,
    set_up,
)
from tests.export.toy_folder import MODEL

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
    assert (
        float(first["projected_gravity.z"]) == -1.0 and 0.0 < float(first["root_ang_vel.x"]) < 0.01
    )
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
        ("time,x\n0,1\n20,1\n", "'time' is 20.0: expected more than 0 and at most 10 s"),
        ("time,x\n0,1\n1,1\n3,1\n", "'time': expected at least two lines at an even rate"),
        ("time,x\n0,1\n1,nan\n", "expected 2 finite numbers in each line"),
        ("time,x\n0,a\n", "no table of numbers"),
    ],
)
def test_a_plan_that_cannot_be_followed_is_refused(control, tmp_path, text, said):
    (tmp_path / "plan.csv").write_text(text)
    with pytest.raises(ValueError, match=said):
        PlanControl(control.meta, tmp_path / "plan.csv")
