"""Speaks as a robot does with the loop in C++, in text on the loopback address: MuJoCo's C engine moves it.

    python simulated_robot.py EXPORT --port 47010

It ends where no command has come for some seconds.
"""

import argparse
import socket
import sys
import time
from pathlib import Path

import numpy as np

SILENT_S = 10.0
COMMAND = ("pos", "vel", "effort", "stiffness", "damping")


def listed(values):
    """Return numbers with commas, or - for what the robot has not."""
    if values is None:
        return "-"
    return ",".join(f"{value:.9g}" for value in values)


def message(count, measured):
    """Return a measurement as udp_robot.h reads it."""
    fields = [str(count)]
    of_joints = (measured.joint_pos, measured.joint_vel, measured.joint_effort)
    for values in (*of_joints, measured.root_quat, measured.root_ang_vel):
        fields.append(listed(values))
    for name, values in measured.estimates.items():
        fields.append(f"{name}={listed(np.ravel(values))}")
    return " ".join(fields).encode()


def serve(robot, command_of, channel, period):
    """Step the robot in real time, with the newest command, until commands end."""
    channel.settimeout(SILENT_S)
    _, loop_address = channel.recvfrom(65536)
    channel.setblocking(False)
    count = 0
    heard = time.monotonic()
    deadline = heard
    # Until a command comes, motors do nothing.
    still = np.zeros(len(robot.read().joint_pos))
    command = command_of(**dict.fromkeys(COMMAND, still))
    while time.monotonic() - heard < SILENT_S:
        channel.sendto(message(count, robot.read()), loop_address)
        # Time does not wait for the loop: without a new command the motors keep the last one.
        deadline += period
        time.sleep(max(0.0, deadline - time.monotonic()))
        while True:
            try:
                line = channel.recv(65536).decode()
            except (BlockingIOError, ConnectionRefusedError):
                break
            heard = time.monotonic()
            if line != "hello":
                fields = [np.array(part.split(","), float) for part in line.split()]
                command = command_of(**dict(zip(COMMAND, fields, strict=True)))
        robot.write(command)
        count += 1


def main():
    """Serve one loop."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "folder", type=Path, help="of an export, whose loop.py has the simulated robot"
    )
    parser.add_argument("--port", type=int, default=47010)
    options = parser.parse_args()
    sys.path.insert(0, str(options.folder))
    # The folder's own files.
    from loop import PolicyControl, read_json
    from runner import JointCommand, SimulatedRobot

    control = PolicyControl(options.folder, read_json(options.folder / "export.json"))
    robot = SimulatedRobot(options.folder, control.estimated)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as channel:
        channel.bind(("127.0.0.1", options.port))
        print(f"a simulated robot waits on port {options.port}", flush=True)
        serve(robot, JointCommand, channel, control.step_dt)


if __name__ == "__main__":
    main()
