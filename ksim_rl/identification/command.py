"""`ksim-rl identify` proposes commands for a robot that is held, and finds its parameters or networks in the log."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ksim_rl import envs
from ksim_rl.checks import OneLineParser, check_choice, check_in_range
from ksim_rl.envs.manager_based_rl_env_cfg import ManagerBasedRlEnvCfg
from ksim_rl.files.writing import check_place, make_folder, write_whole
from ksim_rl.identification.actuator_nets import fit_nets
from ksim_rl.identification.excitation import RATE, SECONDS, propose
from ksim_rl.identification.fit import fit
from ksim_rl.identification.held_robot import TARGETS, HeldRobot, hold
from ksim_rl.identification.joint_log import LEAST_S, TARGET_COLUMNS, TIME, JointLog, read_log
from ksim_rl.identification.simulation import Targets
from ksim_rl.identification.training_overrides import (
    as_word,
    left_out,
    net_override,
    overrides,
    time_step,
)
from ksim_rl.scene.state.joint_control import TargetKind
from ksim_rl.terminal import show


def identify(arguments: Sequence[str]) -> int:
    """Write a plan of commands, or find a robot's numbers or networks; the code is 1 where one of them is doubtful."""
    options: Any = _parser().parse_args(arguments)
    if (options.propose is None) == (options.log is None):
        raise ValueError("give either the LOG of a robot, or --propose ROBOT")
    if options.base is not None:
        options.base = _quaternion(options.base)
    if options.propose is not None:
        return _propose(options)
    if options.robot is None:
        raise ValueError(
            f"--robot: which robot is {options.log} of? A name, or the path of a model"
        )
    if options.nets is not None:
        return _find_nets(options)
    if options.timestep is not None:
        raise ValueError("--timestep: it is of networks: give --nets FOLDER, too")
    return _find(options)


def _propose(options: Any) -> int:
    check_place("--output", options.output, is_folder=False)
    for name in ("robot", "task", "nets", "timestep"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name}: it is of logs; --propose has the name of the robot itself")
    check_in_range("--seconds", options.seconds, low=LEAST_S, high=3600.0)
    robot = hold(options.propose, quat=options.base)
    targets = propose(
        robot, _kinds(options.targets, robot), seconds=options.seconds, seed=options.seed
    )
    path = options.output or Path(f"{Path(options.propose).stem}_plan.csv")
    write_whole(path, _plan(robot, targets))
    seconds = targets.time_T[-1]
    show(
        f"{path}: {seconds:.1f} s at {RATE:g} Hz for {len(robot.joints)} joints. Hold the base in the air, bring the "
        "joints slowly to the first line, then send each line at its time and log it with the columns "
        "<joint>.position of the encoders. Be ready to stop it"
    )
    return 0


def _find(options: Any) -> int:
    check_place("--output", options.output, is_folder=False)
    robot = hold(options.robot, quat=options.base)
    # Everything that could be refused is, before minutes of work.
    cfg = None if options.task is None else envs.task(options.task).cfg()
    log = _read(options.log, robot)
    findings = fit(robot, log, note=show)
    by_task: dict[str, list[str]] = {}
    not_carried: list[str] = []
    if cfg is not None:
        by_task[str(options.task)] = overrides(findings, cfg)
        not_carried = left_out(findings, cfg)
    path = options.output or options.log.with_name(f"{options.log.stem}_found.json")
    write_whole(path, findings.text(by_task))
    show(findings.table())
    for line in findings.warnings:
        show(f"warning: {line}")
    show(f"{path}: the numbers with their 95 % intervals")
    for task, lines in by_task.items():
        words = path.with_suffix(".overrides")
        write_whole(words, "\n".join(lines) + "\n")
        show(f"{words}: for ksim-rl train task={task} $(cat {words})")
    for line in not_carried:
        show(f"not in it: {line}")
    return int(bool(findings.warnings))


def _find_nets(options: Any) -> int:
    cfg = None if options.task is None else envs.task(options.task).cfg()
    timestep = _time_step(options.timestep, cfg)
    folder = options.nets.absolute()
    # What is wrong with the override is said before minutes of work.
    if cfg is not None:
        as_word(str(folder))
        net_override(options.robot, (), cfg)
    robot = hold(options.robot, quat=options.base)
    nets = fit_nets(
        robot, _read(options.log, robot), timestep=timestep, seed=options.seed, note=show
    )
    entries = []
    doubts = []
    make_folder(folder, below=folder.parent)
    for number, net in enumerate(nets):
        # Names of joints are a model's, and might lead elsewhere.
        path = folder / f"motors_{number}.safetensors"
        write_whole(path, net.file)
        entries.append(net.entry(path))
        show(
            f"{path}: off by {net.error:.1%} of the efforts in {net.held_out_s:.1f} s that were held out; the best "
            f"proportional-derivative law is off by {net.pd_error:.1%}"
        )
        if net.doubt:
            doubts.append(net.doubt)
    for line in doubts:
        show(f"warning: {line}")
    if cfg is not None:
        words = folder / "nets.overrides"
        write_whole(words, net_override(robot.name, entries, cfg) + "\n")
        show(f"{words}: for ksim-rl train task={options.task} $(cat {words})")
    return int(bool(doubts))


def _time_step(given: float | None, cfg: ManagerBasedRlEnvCfg | None) -> float:
    """Return the physics step in which networks run, s."""
    if cfg is not None:
        if given is not None:
            raise ValueError("--timestep: --task says it: leave out one of the two")
        return time_step(cfg)
    if given is None:
        raise ValueError(
            "--nets: in which physics steps will the networks run? Give --task, or --timestep in s"
        )
    check_in_range("--timestep", given, low=1e-4, high=0.02)
    return given


def _read(path: Path, robot: HeldRobot) -> JointLog:
    log = read_log(path, robot)
    if log.unread:
        show(f"not read: {', '.join(log.unread)}")
    return log


def _kinds(text: str | None, robot: HeldRobot) -> list[TargetKind]:
    """Return the kinds of commands to propose: the option's, else all that the robot's motors take."""
    if text is None:
        taken = set.intersection(*(set(joint.takes) for joint in robot.joints))
        if not taken:
            raise ValueError(
                "--targets: the robot's motors take different kinds: say which, such as pos,effort"
            )
        return sorted(taken)
    words = text.split(",")
    for word in words:
        check_choice("--targets", word, TARGETS)
    return [kind for kind in TARGETS if kind in words]


def _plan(robot: HeldRobot, targets: Targets) -> str:
    """Return the commands as a CSV file; with the columns of the encoders it is a log."""
    names = [TIME]
    columns = [targets.time_T[:, None]]
    for kind, values_TN in targets.by_kind.items():
        names += [f"{joint}.{TARGET_COLUMNS[kind]}" for joint in robot.joint_names]
        columns.append(values_TN)
    lines = [",".join(names)]
    for row in np.hstack(columns):
        lines.append(",".join(f"{value:.7g}" for value in row))
    return "\n".join(lines) + "\n"


def _quaternion(text: str) -> list[float]:
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    length = float(np.linalg.norm(found))
    if len(found) != 4 or not 0.5 < length < 2.0:
        raise ValueError(
            f"--base {text}: expected a unit quaternion w,x,y,z, such as 1,0,0,0 for upright"
        )
    return [value / length for value in found]


def _parser() -> OneLineParser:
    parser = OneLineParser(
        prog="ksim-rl identify",
        description="Find armature, damping, dry friction, gains, torque constants and the delay of a robot's joints.",
    )
    parser.add_argument(
        "log",
        nargs="?",
        type=Path,
        metavar="LOG",
        help="commands and encoders: .csv, .parquet or .mcap",
    )
    parser.add_argument(
        "--robot", help="that the log is of: a name of the package, or the path of a model"
    )
    parser.add_argument(
        "--task", help="whose training gets what was found: also write overrides for it"
    )
    parser.add_argument(
        "--nets",
        type=Path,
        metavar="FOLDER",
        help="write networks of the motors in place of numbers; the log has measured efforts",
    )
    parser.add_argument(
        "--timestep", type=float, help="in which networks will run, s; default: the step of --task"
    )
    parser.add_argument(
        "--propose", metavar="ROBOT", help="write what to command, in place of reading a log"
    )
    parser.add_argument(
        "--targets", help="of the proposal: pos,vel,effort; default: what the robot's motors take"
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, help="of the proposal; default: 60"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the proposal or the networks")
    parser.add_argument(
        "--base", metavar="W,X,Y,Z", help="how the held base is turned; default: as it stands"
    )
    parser.add_argument("--output", type=Path, metavar="FILE")
    return parser
