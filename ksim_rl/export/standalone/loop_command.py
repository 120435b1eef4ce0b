"""Runs an exported policy on a robot, at the policy's own rate; it needs numpy and onnxruntime, and nothing else.

    python loop.py --simulate               # a robot of MuJoCo's C engine stands up and walks
    python loop.py --simulate --seconds 0   # the same, with words of yours: stand, policy, stop, damp

The policy runs dry first: what it would ask for is shown and checked. Then come the states damp, stand, policy, stop.
Late, lost, repeated or wrong messages, limits of joints, tilt, errors and your stop lead to damped motors. What
happened is in a log that `ksim-rl identify` reads. For a robot of yours write a class with `read`, `write` and
`close` (see `Robot`), and give it to `drive`.
"""

import argparse
import contextlib
import dataclasses
import json
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ksim_rl.export.standalone.commands import as_words
from ksim_rl.export.standalone.deadlines import MonotonicClock
from ksim_rl.export.standalone.dry_run import DryRun, HeardRobot
from ksim_rl.export.standalone.files import Json, check_parent, read_json, refusing
from ksim_rl.export.standalone.journal import Journal
from ksim_rl.export.standalone.loop import (
    ask_for_real_time,
    calm_python,
    first_measurement,
    run_loop,
)
from ksim_rl.export.standalone.plan_control import PlanControl
from ksim_rl.export.standalone.policy_control import PolicyControl
from ksim_rl.export.standalone.robot_link import Control, Robot
from ksim_rl.export.standalone.safety import Limits, option_of, unguarded
from ksim_rl.export.standalone.states import State, StateMachine, Times
from ksim_rl.export.standalone.words import (
    EndOfDryRun,
    EndOfPlan,
    Interrupts,
    Keyboard,
    Operator,
    Unattended,
)

UNATTENDED_S = 10.0
LIFT = 1.0
"""m, of a simulated robot that follows a plan: its legs hang freely."""
HELP = {
    "late_periods": "periods without a new message, or by which the loop may be late",
    "most_tilt": "of the root from the vertical, rad",
    "position_margin": "beyond the limits of joints in export.json, rad or m",
    "most_speed": "of joints without a speed limit in export.json, per s",
    "same_seconds": "for which all that a robot with a gyroscope measures may be the same",
    "effort_share": "of the effort limits in export.json; begin with little",
    "dry_seconds": "of the policy on what the robot measures, unsent, before it stands up and before it moves",
    "stand_seconds": "from the measured pose to the default pose",
    "blend_seconds": "from standing to the policy's targets",
    "stop_seconds": "from the gains of the moment to none",
    "damp_seconds": "of braking at the end",
    "damping_factor": "of joint_damping in export.json, while motors only brake",
}


def loop_parser() -> argparse.ArgumentParser:
    """Return the options of a loop, to which a robot's own program may add."""
    parser = argparse.ArgumentParser(description="Run an exported policy on a robot.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parent)
    parser.add_argument("--simulate", action="store_true", help="a robot of MuJoCo's C engine")
    parser.add_argument(
        "--hang",
        action="store_true",
        help="the simulated robot hangs until the policy begins, as a humanoid has to",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        help="of the policy, without an operator, who may still stop it; 0: words of yours lead from state to state "
        f"(default: {UNATTENDED_S:g} with --simulate, else 0)",
    )
    parser.add_argument(
        "--plan",
        type=Path,
        help="commands of `ksim-rl identify --propose` in the policy's place, for a robot whose base is held; the log "
        "has them alone",
    )
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="end behind the first dry run; a robot is sent nothing, and may stand under another controller meanwhile",
    )
    parser.add_argument("--command", type=float, nargs="+", help="the policy's first command")
    parser.add_argument("--log", type=Path, help="a new CSV file; default: named by the time")
    parser.add_argument(
        "--real-time",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="ask the system to run the loop before all else; whether it does is in the log",
    )
    parser.add_argument("--report", type=Path, help="a JSON file for how punctual the loop was")
    for owner in (Limits, Times):
        for field in dataclasses.fields(owner):
            text = f"{HELP[field.name]} (default: {field.default:g})"
            parser.add_argument(option_of(field.name), type=float, default=field.default, help=text)
    return parser


def drive(
    robot: Robot | None,
    control: PolicyControl,
    options: argparse.Namespace,
    *,
    operators: Sequence[Operator] = (),
) -> int:
    """Run a policy on a robot with the options of `loop_parser`, and return the exit code: 1 after a fault.

    Without a robot it is the simulated one. `operators` are heard beside the keyboard. A ValueError says what is wrong
    before anything moves.
    """
    _check_options(options, has_robot=robot is not None)
    plan = None
    if options.plan is not None:
        plan = PlanControl(control.meta, options.plan)
    period = control.step_dt if plan is None else plan.period
    driver = plan or control
    chosen = vars(options)
    limits = Limits(**{field.name: chosen[field.name] for field in dataclasses.fields(Limits)})
    times = Times(**{field.name: chosen[field.name] for field in dataclasses.fields(Times)})
    _set_command(control, options.command)
    clock = MonotonicClock()
    dry = None
    if plan is None:
        dry = DryRun(
            control,
            period=period,
            seconds=times.dry_seconds,
            margin=limits.position_margin,
            clock=clock.now,
        )
    if robot is None:
        robot = _simulated(options, control, period, holds=0 if dry is None else dry.num_steps)
    elif options.dry_run:
        robot = HeardRobot(robot)
    first = first_measurement(robot, clock, period)
    lacking = driver.lacking(first)
    if lacking:
        raise ValueError(
            f"the policy observes {', '.join(lacking)}, which this robot does not measure: give estimates, or train "
            "without these observations"
        )
    path = options.log
    if path is None:
        path = Path(time.strftime("loop_%Y%m%d_%H%M%S.csv"))
    # What is identified is the plan alone: gains change in other states.
    only = None if plan is None else State.POLICY
    journal = Journal(path, driver.joints, _say, only=only, dry=dry is not None)
    machine = StateMachine(
        driver, period=control.step_dt, limits=limits, times=times, note=journal.event, dry=dry
    )
    heard = _operators(options, plan, operators)
    calm_python()
    priority = ask_for_real_time() if options.real_time else "no real-time priority: not asked for"
    for line in [priority, *unguarded(driver.joints, first), *_said_of_commands(driver)]:
        journal.event(clock.now(), line)
    try:
        punctuality = run_loop(robot, machine, heard, journal, clock=clock, period=period)
    finally:
        robot.close()
        journal.close()
    summary = {
        **punctuality.summary(),
        "period_ms": 1e3 * period,
        "three_periods_late": punctuality.woken.count_beyond(3.0 * period),
        "priority": priority,
        "fault": machine.fault,
        "clipped": machine.effort_limit.clipped(),
        "log": str(path),
        "lines_lost": journal.lost,
    }
    _tell(summary, journal.failure)
    if options.report:
        options.report.write_text(json.dumps(summary, indent=1) + "\n")
    is_dry = dry is not None and dry.is_over()
    return 1 if machine.fault or (options.dry_run and not is_dry) else 0


def _check_options(options: argparse.Namespace, *, has_robot: bool) -> None:
    """Refuse options that do not go together, before a robot is even read."""
    if has_robot and (options.simulate or options.hang):
        raise ValueError(
            "--simulate and --hang are of the simulated robot: this program drives another one"
        )
    if options.seconds is not None and not options.seconds >= 0.0:
        raise ValueError(f"--seconds {options.seconds:g}: expected 0 or more")
    if options.plan is not None and options.command is not None:
        raise ValueError("--command: a plan follows none: leave out one of the two")
    if options.plan is not None and options.seconds:
        raise ValueError("--seconds: a plan says itself how long it is: leave out one of the two")

    if options.report is not None:
        check_parent("--report", options.report)
    if options.dry_run and options.plan is not None:
        raise ValueError("--dry-run: a plan has no policy that could run: leave out one of the two")
    if options.dry_run and options.seconds:
        raise ValueError("--seconds: a dry run has --dry-seconds: leave out one of the two")


def _operators(
    options: argparse.Namespace, plan: PlanControl | None, others: Sequence[Operator]
) -> list[Operator]:
    """Return all sources of operator words; from here on signals of the system count as words, too."""
    interrupts = Interrupts()
    interrupts.listen()
    heard: list[Operator] = [interrupts, *others]
    seconds = options.seconds
    if seconds is None:
        seconds = UNATTENDED_S if options.simulate else 0.0
    if plan is not None:
        heard.append(EndOfPlan(plan))
        # The plan says itself when it is over; 0 stays, as an operator leads then.
        seconds = math.inf if seconds else 0.0
    if options.dry_run:
        heard.append(EndOfDryRun())
        # The end is set; a missing keyboard must not end it sooner.
        heard.append(Keyboard(sys.stdin, leads=False))
        return heard
    heard.append(Keyboard(sys.stdin, leads=not seconds))
    if seconds:
        heard.append(Unattended(seconds))
    return heard


def _simulated(
    options: argparse.Namespace, control: PolicyControl, period: float, *, holds: int
) -> Robot:
    # Here, so that a robot's computer needs no MuJoCo.
    try:
        from ksim_rl.export.standalone.simulated_robot import SimulatedRobot
    except ImportError as error:
        raise ValueError(f"--simulate: {error}: install mujoco, and keep runner.py here") from None
    with refusing(options.folder):
        robot = SimulatedRobot(options.folder, control.estimated)
    robot.change_period(period)
    if options.plan is not None:
        # The base of a robot that is identified is held, and nothing touches.
        robot.hang(np.full(len(control.joints.names), np.inf), lift=LIFT)
    elif options.hang:
        # No humanoid stands on stiff motors alone for as long as the dry run lasts.
        robot.hang(control.joints.stiffness, holds=holds)
    return robot


def _set_command(control: PolicyControl, values: Sequence[float] | None) -> None:
    if values is None:
        return
    if not np.isfinite(values).all():
        raise ValueError(f"--command {' '.join(map(str, values))}: expected finite numbers")
    for name, command in control.command.items():
        if len(values) != len(command):
            raise ValueError(f"--command: {len(values)} numbers: {name} has {len(command)}")
        control.ranges[name].check(np.array(values))
        command[:] = values
        return
    raise ValueError("--command: this policy takes no command")


def _said_of_commands(control: Control) -> list[str]:
    """Return a line for each command: its first value, and its range."""
    lines = []
    for name, values in control.command.items():
        allowed = control.ranges[name]
        # No zero may be among what the policy has seen, as for the place where a hand should be.
        values[:] = allowed.clip(values)
        lines.append(f"command {name}: {as_words(values)}, of {allowed}")
    return lines


def _tell(summary: Json, failure: str) -> None:
    _say(
        f"{summary['periods']} periods of {summary['period_ms']:g} ms, {summary['missed_periods']} missed; 99 % with "
        f"own jitter up to {summary['own_jitter_ms_p99']:.2f} ms, and sent up to "
        f"{summary['sent_after_deadline_ms_p99']:.2f} ms after the deadline"
    )
    if summary["clipped"]:
        _say(f"commands at the effort limit, by joint: {summary['clipped']}")
    _say(f"log: {summary['log']}, {summary['lines_lost']} lines lost")
    if failure:
        _say(f"the log is not whole: {failure}")


def _say(text: str) -> None:
    # A terminal that is gone ends neither the log nor the report.
    with contextlib.suppress(OSError):
        print(text, flush=True)


def main() -> None:
    """Run the loop on the simulated robot."""
    parser = loop_parser()
    options = parser.parse_args()
    if not options.simulate:
        parser.error("give --simulate, or run the program of your robot, which calls `drive`")
    try:
        control = PolicyControl(options.folder, read_json(options.folder / "export.json"))
        code = drive(None, control, options)
    except (ValueError, OSError) as error:
        parser.exit(2, f"loop.py: error: {' '.join(str(error).split())}\n")
    sys.exit(code)


if __name__ == "__main__":
    main()
