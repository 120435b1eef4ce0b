"""Runs an exported policy at its own rate, with limits; the robot is MuJoCo's, where yours will stand.

python examples/deploy/loop.py RUN/export --seconds 10

To drive a robot, replace `SimulatedRobot`: `read` fills the inputs of `obs.onnx` by the names of `obs.measurements` in
export.json, and clips and scales what it gives; `write` sends joint targets by name. Read docs/deploy.md first.
"""

import argparse
import importlib.util
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

MOST_TILT = math.radians(50.0)


class Stopped(Exception):  # noqa: N818
    """A limit was passed: hold the robot softly, and find out why."""


class SimulatedRobot:
    """A stand-in for a robot: MuJoCo steps the exported model with the targets that it is given."""

    def __init__(self, runner: Any) -> None:
        self.runner = runner

    def read(self) -> Any:
        """Return the newest frame that the policy reads."""
        return self.runner.frame

    def write(self, action: Any) -> None:
        """Run one step of control."""
        self.runner.step(action)

    def tilt(self) -> float:
        """Return the angle between the root's z axis and the vertical, rad."""
        root = self.runner.model.jnt_bodyid[0]
        return float(np.arccos(np.clip(self.runner.data.xmat[root].reshape(3, 3)[2, 2], -1.0, 1.0)))


def check(meta: dict[str, Any], runner: Any, robot: SimulatedRobot) -> None:
    """Raise Stopped where a joint, an effort or the tilt is beyond its limit."""
    names, limits = meta["joints"]["names"], meta["joints"]["limits"]
    for name, ends, effort in zip(names, limits["position"], limits["effort"], strict=True):
        position = runner.data.qpos[runner.joints[name][0]]
        reach = 0.1
        if ends[0] is not None and not ends[0] - reach <= position <= ends[1] + reach:
            raise Stopped(
                f"joint {name} is at {position:.2f}: expected {ends[0]:.2f} to {ends[1]:.2f}"
            )
        torque = runner.data.qfrc_actuator[runner.joints[name][1]]
        if effort is not None and abs(torque) > 1.01 * effort:
            raise Stopped(
                f"joint {name} is driven with {torque:.1f}: expected at most {effort:.1f}"
            )
    if runner.model.jnt_type[0] == 0 and robot.tilt() > MOST_TILT:
        raise Stopped(f"tilted by {math.degrees(robot.tilt()):.0f} degrees")


def main() -> None:
    """Run the loop, and say how late its latest step was."""
    parser = argparse.ArgumentParser(description="Run an exported policy at its own rate.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument(
        "--command", type=float, nargs="*", help="values of the first command, such as 0.5 0 0"
    )
    options = parser.parse_args()
    spec = importlib.util.spec_from_file_location("runner", options.folder / "runner.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Your own export: the folder of a stranger is for `ksim-rl sim2sim`.
    spec.loader.exec_module(module)
    runner = module.Runner(options.folder)
    meta = json.loads((options.folder / "export.json").read_text())
    if options.command:
        runner.command[meta["command_names"][0]] = np.array(options.command)
    runner.noisy = False
    runner.reset()
    robot, late = SimulatedRobot(runner), 0.0
    due = time.perf_counter()
    for _ in range(round(options.seconds / meta["step_dt"])):
        robot.write(runner.policy(robot.read()))
        try:
            check(meta, runner, robot)
        except Stopped as reason:
            sys.exit(f"stopped: {reason}")
        due += meta["step_dt"]
        late = max(late, time.perf_counter() - due)
        time.sleep(max(0.0, due - time.perf_counter()))
    print(
        f"{options.seconds:g} s at {1.0 / meta['step_dt']:g} Hz; latest step {1e3 * max(late, 0.0):.1f} ms behind"
    )


if __name__ == "__main__":
    main()
