"""A robot of MuJoCo's that speaks as Unitree's do: takes `rt/lowcmd`, sends `rt/lowstate`, refuses wrong checksums.

python -m unitree_bridge.stub go2 RUN/export --interface lo
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from unitree_bridge import connection
from unitree_bridge.checksum import checksum
from unitree_bridge.exported import module_of
from unitree_bridge.robot import SENSORS
from unitree_bridge.robots import KINDS, Kind, zeros

GYROSCOPE_NOISE = 1e-3
"""rad/s, of the simulated gyroscope."""


class Stub:
    """The simulated robot of an exported folder, behind the messages of a kind; `runner` is that folder's module."""

    def __init__(
        self, kind: Kind, runner: Any, folder: Path, *, interface: str, domain: int = 0
    ) -> None:
        self.kind = kind
        self.runner = runner
        self.robot = runner.SimulatedRobot(folder, ())
        # A robot's motors take commands at any time, and not once a period.
        self.robot.runner.decimation = 1
        self.period = float(self.robot.model.opt.timestep)
        names = self.robot.runner.meta["joints"]["names"]
        self.places = [names.index(name) for name in kind.joints]
        of = connection.participant(interface, domain)
        self.commands = connection.reader(of, connection.COMMANDS, kind.messages.LowCmd)
        self.states = connection.writer(of, connection.STATES, kind.messages.LowState)
        self.state = zeros(kind.messages.LowState)
        self.newest: Any = None
        self.sensors = {}
        for name, field in SENSORS.items():
            if name in [self.robot.model.sensor(k).name for k in range(self.robot.model.nsensor)]:
                node = {"quantity": "sensor", "sensor": name}
                self.sensors[field] = self.robot.runner.quantity(node)
        self.refused = 0
        self.taken = 0
        self.remote = bytes(40)
        self.draws = np.random.default_rng(0)

    def step(self) -> None:
        """Run one step of physics under the newest command, and send the state; before the first it stands still."""
        for command in connection.take(self.commands, self.kind.messages.LowCmd):
            if command.crc != checksum(command, self.kind.layout):
                self.refused += 1
                continue
            self.taken += 1
            self.newest = command
        if self.newest is not None:
            self.robot.write(self._command(self.newest))
        self._send()

    def _command(self, message: Any) -> Any:
        size = len(self.robot.pos)
        arrays = {}
        pairs = {"pos": "q", "vel": "dq", "effort": "tau", "stiffness": "kp", "damping": "kd"}
        for name, short in pairs.items():
            values = np.zeros(size)
            for motor, place in enumerate(self.places):
                # A motor that is not enabled exerts nothing.
                if message.motor_cmd[motor].mode:
                    values[place] = getattr(message.motor_cmd[motor], short)
            arrays[name] = values
        return self.runner.JointCommand(**arrays)

    def _send(self) -> None:
        read = self.robot.read()
        for motor, place in enumerate(self.places):
            state = self.state.motor_state[motor]
            state.q = float(read.joint_pos[place])
            state.dq = float(read.joint_vel[place])
            state.tau_est = float(read.joint_effort[place])
        self.state.imu_state.quaternion = read.root_quat.tolist()
        # No gyroscope reads the same twice, also while the robot stands still.
        noise = GYROSCOPE_NOISE * self.draws.standard_normal(3)
        self.state.imu_state.gyroscope = (read.root_ang_vel + noise).tolist()
        for field, sensor in self.sensors.items():
            setattr(self.state.imu_state, field, sensor().tolist())
        self.state.wireless_remote = list(self.remote)
        self.state.tick = (self.state.tick + 1) % 2**32
        self.states.write(self.state)


def main() -> None:
    """Run the stub in real time, until it is interrupted."""
    parser = argparse.ArgumentParser(prog="python -m unitree_bridge.stub", description=__doc__)
    parser.add_argument("robot", choices=sorted(KINDS))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--interface", default="lo")
    parser.add_argument("--domain", type=int, default=0)
    options = parser.parse_args()
    try:
        stub = Stub(
            KINDS[options.robot],
            module_of(options.folder, "runner"),
            options.folder,
            interface=options.interface,
            domain=options.domain,
        )
    except ValueError as error:
        parser.error(str(error))
    deadline = time.monotonic()
    while True:
        stub.step()
        deadline = max(deadline + stub.period, time.monotonic() - 1.0)
        time.sleep(max(0.0, deadline - time.monotonic()))


if __name__ == "__main__":
    main()
