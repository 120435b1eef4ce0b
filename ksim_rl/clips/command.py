"""`ksim-rl motion` turns recordings into motion files of a robot: from CSV, BVH or AMASS-like archives."""

from collections.abc import Sequence
from pathlib import Path

import mujoco

from ksim_rl.checks import OneLineParser, naming, near
from ksim_rl.clips.amass import HEIGHT, read_amass
from ksim_rl.clips.bvh import read_bvh
from ksim_rl.clips.motion_file import write_motion
from ksim_rl.clips.retarget import read_retarget, retargeted
from ksim_rl.clips.robot_csv import read_csv
from ksim_rl.physics import load_spec
from ksim_rl.scene.robots.booster_t1 import BoosterT1
from ksim_rl.scene.robots.own_robots import Humanoid
from ksim_rl.scene.robots.unitree_g1 import UnitreeG1
from ksim_rl.terminal import show

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
    """Convert one file; a ValueError names its fault."""
    options = _parser().parse_args(arguments)
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
    return 0


def _parser() -> OneLineParser:
    parser = OneLineParser(prog="ksim-rl motion", description=__doc__)
    kinds = parser.add_subparsers(dest="kind", required=True)
    for kind, said in (
        ("csv", "root position, quaternion (x, y, z, w) and joints of the robot itself"),
        ("bvh", "a skeleton's motion"),
        ("amass", "an .npz with poses, trans and mocap_framerate"),
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
        one.add_argument(
            "--pairs", type=Path, required=True, help="a YAML file: see docs/motions.md"
        )
        if kind == "bvh":
            one.add_argument("--unit", type=float, default=0.01, help="m per unit of the file")
            one.add_argument("--z-up", action="store_true")
        else:
            one.add_argument("--height", type=float, default=HEIGHT, help="of the person, m")
    return parser
