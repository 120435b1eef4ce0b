"""Runs an exported policy on a Go2 or G1.

python -m unitree_bridge go2 RUN/export --interface eth0
"""

import argparse
import sys
from pathlib import Path

from unitree_bridge.exported import module_of
from unitree_bridge.robot import UnitreeRobot
from unitree_bridge.robots import KINDS


def main() -> int:
    """Run the loop of the exported folder on the robot, and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m unitree_bridge",
        description=__doc__,
        epilog="Options of the folder's loop.py may follow.",
    )
    parser.add_argument("robot", choices=sorted(KINDS))
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--interface", required=True, help="of the network, such as eth0; lo: the stub"
    )
    parser.add_argument("--domain", type=int, default=0)
    options, others = parser.parse_known_args()
    try:
        loop = module_of(options.folder, "loop")
    except ValueError as error:
        parser.error(str(error))
    chosen = loop.loop_parser().parse_args([str(options.folder), *others])
    if chosen.simulate or chosen.hang:
        parser.error(
            "--simulate and --hang are of loop.py alone: here `python -m unitree_bridge.stub` simulates"
        )
    try:
        meta = loop.read_json(options.folder / "export.json")
        control = loop.PolicyControl(options.folder, meta)
        robot = UnitreeRobot(
            KINDS[options.robot], loop, meta, interface=options.interface, domain=options.domain
        )
        return loop.drive(robot, control, chosen, operators=[robot])
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main())
