"""A robot of Unitree's for `loop.py`: measurements of `rt/lowstate`, commands to `rt/lowcmd`, words of its remote."""

import time
from typing import Any

import numpy as np

from unitree_bridge import connection
from unitree_bridge.checksum import checksum
from unitree_bridge.robots import ENABLED, Kind

# Bits of the two bytes of buttons in `wireless_remote`.
BUTTONS = {"select": 3, "start": 2, "A": 8, "B": 9}
WORDS = {"start": "stand", "A": "policy", "select": "stop", "B": "damp"}
FIRST_BUTTONS = 2
# Sensors of ksim_rl's robots, and what measures them; both in the axes of the body.
SENSORS = {"imu_ang_vel": "gyroscope", "imu_lin_acc": "accelerometer"}


class UnitreeRobot:
    """A Go2 or G1 on a network interface; `loop` is the module of the exported folder, `meta` its export.json."""

    def __init__(
        self, kind: Kind, loop: Any, meta: dict[str, Any], *, interface: str, domain: int = 0
    ) -> None:
        names = meta["joints"]["names"]
        for name in kind.joints:
            if name not in names:
                raise ValueError(
                    f"{kind.name} has the joint {name!r}, which the policy's robot has not: give an export of it"
                )
        for name in names:
            if name not in kind.joints:
                raise ValueError(f"export.json: {kind.name} has no joint {name!r}")
        self.kind = kind
        self.measurement = loop.Measurement
        # By motor: the joint's place in arrays of the loop; by joint: its motor.
        self.places = [names.index(name) for name in kind.joints]
        self.motors = [kind.joints.index(name) for name in names]
        self.estimated: dict[str, str] = {}
        for node in (meta["obs"] or {"measurements": ()})["measurements"]:
            if node.get("sensor") in SENSORS:
                self.estimated[node["input"]] = SENSORS[node["sensor"]]
        of = connection.participant(interface, domain)
        self.states = connection.reader(of, connection.STATES, kind.messages.LowState)
        self.commands = connection.writer(of, connection.COMMANDS, kind.messages.LowCmd)
        self.command = kind.command()
        for motor in range(len(kind.joints)):
            self.command.motor_cmd[motor].mode = ENABLED
        self.newest: Any = None
        # None since the last words: no message has come.
        self.pressed: set[str] | None = None
        # A button that is held down from the beginning was not meant for this loop.
        self.held = set(BUTTONS)

    def read(self) -> Any:
        """Return the newest measurement, None before the first; one that arrived since the last call is of now."""
        arrived = connection.take(self.states, self.kind.messages.LowState)
        if not arrived:
            return self.newest
        state = arrived[-1]
        # G1 wants its own machine's number in each command.
        if hasattr(state, "mode_machine"):
            self.command.mode_machine = state.mode_machine
        pressed = pressed_buttons(bytes(state.wireless_remote))
        self.pressed = pressed | (self.pressed or set())
        motors = [state.motor_state[motor] for motor in self.motors]
        imu = state.imu_state
        estimates = {}
        for name, sensor in self.estimated.items():
            estimates[name] = np.array(getattr(imu, sensor))
        self.newest = self.measurement(
            stamp=time.monotonic(),
            joint_pos=np.array([motor.q for motor in motors]),
            joint_vel=np.array([motor.dq for motor in motors]),
            joint_effort=np.array([motor.tau_est for motor in motors]),
            root_quat=np.array(imu.quaternion),
            root_ang_vel=np.array(imu.gyroscope),
            # It stands still where the firmware sends one state again and again.
            count=int(state.tick),
            estimates=estimates,
        )
        return self.newest

    def write(self, command: Any) -> None:
        """Send a command."""
        for motor, place in enumerate(self.places):
            asked = self.command.motor_cmd[motor]
            asked.q = float(command.pos[place])
            asked.dq = float(command.vel[place])
            asked.tau = float(command.effort[place])
            asked.kp = float(command.stiffness[place])
            asked.kd = float(command.damping[place])
        self.command.crc = checksum(self.command, self.kind.layout)
        self.commands.write(self.command)

    def words(self, now: float, machine: Any) -> list[str]:
        """Return the words of the remote's buttons that were pressed since the last call."""
        if self.pressed is None:
            return []
        found = [WORDS[name] for name in sorted(self.pressed - self.held)]
        self.held = self.pressed
        self.pressed = None
        return found

    def close(self) -> None:
        """Do nothing: without commands the motors stay as the last one has them, until the firmware lets go."""


def pressed_buttons(remote: bytes) -> set[str]:
    """Return the buttons that are pressed, of `BUTTONS`."""
    bits = int.from_bytes(remote[FIRST_BUTTONS : FIRST_BUTTONS + 2], "little")
    return {name for name, place in BUTTONS.items() if bits >> place & 1}
