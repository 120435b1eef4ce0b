"""`ksim-rl motion` makes motion files of a robot: of CSV, BVH, AMASS and tracking files, of runs, and of own plans."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import mujoco

from ksim_rl.checks import OneLineParser, naming, near
from ksim_rl.clips.amass import HEIGHT, read_amass
from ksim_rl.clips.bvh import read_bvh
from ksim_rl.clips.mirrored import mirrored
from ksim_rl.clips.motion_file import write_motion
from ksim_rl.clips.retarget import read_retarget, retargeted
from ksim_rl.clips.robot_csv import read_csv
from ksim_rl.clips.tracking_file import read_tracking
from ksim_rl.files.writing import check_place
from ksim_rl.physics import load_spec
from ksim_rl.scene.motions.motion_set import MIRRORED
from ksim_rl.scene.names import match_names
from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.robots.own_robots import Humanoid
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.terminal import show
from ksim_rl.tracking.assistance import rolled_out
from ksim_rl.tracking.feasibility import feasibility
from ksim_rl.tracking.g1_motions import FIGURE, FPS
from ksim_rl.tracking.g1_motions import model as g1
from ksim_rl.tracking.g1_repertoire import REPERTOIRE
from ksim_rl.tracking.keyframes import perform
from ksim_rl.trainers.run_folder import load_policy

ROBOTS = {"g1": UnitreeG1, "t1": BoosterT1, "humanoid": Humanoid}


def model_of(robot: str) -> mujoco.MjModel:
    """Return a robot of ours by name, or of a file, alone in its model."""
    if robot in ROBOTS:
        # Without a scene: ground and sensors have no part in kinematics.
        return ROBOTS[robot]().spec().compile()
    # Without a suffix or a folder it was meant as a name, and the near names help.
    if not Path(robot).suffix and "/" not in robot:
        raise ValueError(f"--robot {robot}: {near(robot, ROBOTS)}; or give the path of a model")
    return load_spec(robot).compile()


def motion(arguments: Sequence[str]) -> int:
    """Convert one file, or write a folder of our own motions; a ValueError names a fault."""
    options = _parser().parse_args(arguments)
    if options.kind == "generate":
        check_place("folder", options.folder, is_folder=True)
        return _generate(options.folder, options.only)
    check_place("motion", options.motion, is_folder=False)
    if options.kind == "rollout":
        return _roll_out(options)
    model = model_of(options.robot)
    # A CSV holds the robot's own joints, so nothing has to be retargeted.
    if options.kind == "csv":
        if options.joints:
            joints = options.joints.split(",")
        else:
            joints = None
        qpos_FL = read_csv(
            options.source, model, fps=options.source_fps, wanted_fps=options.fps, joints=joints
        )
    elif options.kind == "tracking":
        qpos_FL = read_tracking(options.source, model, wanted_fps=options.fps)
    else:
        # Both become recordings of points, which are then retargeted.
        if options.kind == "bvh":
            recording = read_bvh(options.source, scale=options.unit, y_up=not options.z_up)
        else:
            recording = read_amass(options.source, height=options.height)
        pairs = read_retarget(options.pairs)
        with naming(str(options.source)):
            qpos_FL = retargeted(recording, model, pairs, fps=options.fps)
    write_motion(options.motion, model, qpos_FL, options.fps)
    show(f"{options.motion}: {len(qpos_FL)} frames, {(len(qpos_FL) - 1) / options.fps:.2f} s")
    # Of G1 the soles are known, and with them what the ground has to give.
    if options.kind == "tracking" and options.robot == "g1":
        for fault in feasibility(model, qpos_FL, options.fps, figure=FIGURE).faults():
            show(f"  not feasible as it is: {fault}")
    return 0


def _roll_out(options: argparse.Namespace) -> int:
    """Write what the policy of a tracking run does along its motion, as a motion for another policy."""
    policy = load_policy(options.run, device=options.device)
    found, model = rolled_out(
        policy.cfg, policy.actor, clip=options.clip, trials=options.trials, note=show
    )
    write_motion(options.motion, model, found.qpos_FL, found.fps)
    seconds = (len(found.qpos_FL) - 1) / found.fps
    show(
        f"{options.motion}: {len(found.qpos_FL)} frames, {seconds:.2f} s; {found.success:.1%} of {options.trials} "
        f"trials came to the end, and this one was off the motion by {found.error:.3f}"
    )
    return 0


def _generate(folder: Path, only: str) -> int:
    """Write the motions of `REPERTOIRE` whose names match a regular expression, and their mirror images."""
    names = [list(REPERTOIRE)[place] for place in match_names("motion", (only,), list(REPERTOIRE))]
    model = g1()
    folder.mkdir(parents=True, exist_ok=True)
    infeasible = 0
    for name in names:
        clip = REPERTOIRE[name]
        qpos_FL, _, planted_FN = perform(model, FIGURE, clip.plan(), fps=FPS, shift_s=clip.shift_s)
        faults = feasibility(model, qpos_FL, FPS, figure=FIGURE, planted_FN=planted_FN).faults()
        # What the robot cannot do would only teach a policy to fall.
        if faults:
            infeasible += 1
            show(f"{name}: not written: {'; '.join(faults)}")
            continue
        write_motion(folder / f"{name}.npz", model, qpos_FL, FPS)
        write_motion(folder / f"{name}{MIRRORED}.npz", model, mirrored(model, qpos_FL), FPS)
        show(
            f"{name}: {len(qpos_FL)} frames, {(len(qpos_FL) - 1) / FPS:.2f} s, and its mirror image"
        )
    return min(infeasible, 1)


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="ksim-rl motion", description=__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    for kind, said in (
        ("csv", "root position, quaternion (x, y, z, w) and joints of the robot itself"),
        ("bvh", "a skeleton's motion"),
        ("amass", "an .npz with poses, trans and mocap_framerate"),
        (
            "tracking",
            "an .npz of mjlab's or BeyondMimic's tracking tasks, with names of joints and bodies",
        ),
    ):
        one = kinds.add_parser(kind, help=said)
        one.add_argument("source", type=Path)
        one.add_argument("motion", type=Path, help="the .npz file to write")
        one.add_argument(
            "--robot", default="g1", help=f"{', '.join(ROBOTS)}, or a path; default: g1"
        )
        one.add_argument("--fps", type=float, default=50.0, help="of the motion: the control rate")
        if kind == "csv":
            one.add_argument("--source-fps", type=float, default=30.0)
            one.add_argument(
                "--joints", default="", help="of the file's columns, if not the model's order"
            )
            continue
        if kind == "tracking":
            continue
        one.add_argument(
            "--pairs", type=Path, required=True, help="a YAML file: see docs/motions.md"
        )
        if kind == "bvh":
            one.add_argument("--unit", type=float, default=0.01, help="m per unit of the file")
            one.add_argument("--z-up", action="store_true")
        else:
            one.add_argument("--height", type=float, default=HEIGHT, help="of the person, m")
    rollout = kinds.add_parser(
        "rollout", help="what the policy of a tracking run does along its motion, without help"
    )
    rollout.add_argument("run", type=Path, help="a run folder, or one of its checkpoints")
    rollout.add_argument("motion", type=Path, help="the .npz file to write")
    rollout.add_argument("--clip", default="", help="of several clips the one to follow")
    rollout.add_argument("--trials", type=int, default=64, help="of which the best is written")
    rollout.add_argument("--device", default="auto", help="cpu, cuda, cuda:<index> or auto")
    own = kinds.add_parser(
        "generate", help="the package's plans of Unitree G1, 77 motions of thirteen kinds"
    )
    own.add_argument(
        "folder", type=Path, help="where to write, an .npz file for each, and its mirror image"
    )
    own.add_argument("--only", default=".*", help="names to make, a regular expression: walk_.*")
    return parser
